#include "sfm/gps.h"

#include <algorithm>
#include <cmath>
#include <numbers>

namespace nrff {

std::vector<GpsPosition> GpsPositions(const Capture& capture) {
  std::vector<GpsPosition> positions;
  for (const CaptureImage& photo : capture.images) {
    if (!photo.info.gps) return {};
    positions.push_back(*photo.info.gps);
  }
  return positions;
}

Eigen::Matrix3Xd LocalPositions(const std::vector<GpsPosition>& positions) {
  constexpr double kRadian = std::numbers::pi / 180, kEquator_m = 6378137, kEccentricitySquared = 6.69437999014e-3;
  const bool has_altitude = std::all_of(positions.begin(), positions.end(), [](const auto& p) { return p.altitude_m; });
  Eigen::Matrix3Xd local(3, Eigen::Index(positions.size()));
  if (positions.empty()) return local;
  const GpsPosition& first = positions.front();
  // Radii of curvature along the meridian and across it.
  const double sine = std::sin(first.latitude_deg * kRadian), w = 1 - kEccentricitySquared * sine * sine;
  const double north_m = kEquator_m * (1 - kEccentricitySquared) / (w * std::sqrt(w));
  const double east_m = kEquator_m / std::sqrt(w) * std::cos(first.latitude_deg * kRadian);
  for (Eigen::Index i = 0; i < local.cols(); ++i) {
    const GpsPosition& position = positions[size_t(i)];
    // The short way round: 179.99° is near −179.99°.
    const double east_deg = std::remainder(position.longitude_deg - first.longitude_deg, 360);
    local.col(i) << east_m * east_deg * kRadian, north_m * (position.latitude_deg - first.latitude_deg) * kRadian,
        has_altitude ? *position.altitude_m : 0;
  }
  return local.colwise() - local.rowwise().mean().eval();
}

double Spread_m(const Eigen::Matrix3Xd& positions) {
  if (positions.cols() == 0) return 0;
  return std::sqrt((positions.colwise() - positions.rowwise().mean().eval()).colwise().squaredNorm().mean());
}

Eigen::MatrixXf Nearness(const Eigen::Matrix3Xd& positions) {
  Eigen::MatrixXf nearness(positions.cols(), positions.cols());
  for (Eigen::Index i = 0; i < positions.cols(); ++i)
    nearness.col(i) = -(positions.colwise() - positions.col(i)).colwise().norm().transpose().cast<float>();
  return nearness;
}

}  // namespace nrff
