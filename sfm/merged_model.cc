#include "sfm/merged_model.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <string>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/statistics.h"
#include "sfm/distortion.h"
#include "sfm/trajectory_errors.h"

namespace nrff {
namespace {

using Eigen::Matrix3d;
using Eigen::Matrix4d;
using Eigen::Vector2d;
using Eigen::Vector3d;

constexpr size_t kFewestCameras = 3;

Trajectory CamerasOf(const ColmapModel& model) {
  Trajectory trajectory;
  for (const auto& [id, image] : model.images) {
    trajectory.push_back({image.name, image.rotation.conjugate(), image.Center()});
  }
  std::sort(trajectory.begin(), trajectory.end(), [](const auto& a, const auto& b) { return a.name < b.name; });
  return trajectory;
}

std::optional<Vector2d> Project(const ColmapImage& image, const Lens& lens, const Vector3d& point) {
  const Vector3d p = image.rotation * point + image.translation;
  if (!(p.z() > 0)) return {};
  return lens.ImageFromCamera(p.head<2>() / p.z());
}

}  // namespace

std::optional<WorldShift> MeasureShift(const ColmapModel& earlier, const ColmapModel& now) {
  const Trajectory before = CamerasOf(earlier), after = CamerasOf(now);
  std::map<std::string, const ColmapImage*> image_now;
  for (const auto& [id, image] : now.images) image_now[image.name] = &image;
  Matches matches{{}, "name"};
  for (size_t i = 0, j = 0; i < after.size() && j < before.size();) {
    const int order = after[i].name.compare(before[j].name);
    if (order == 0) matches.pairs.emplace_back(i, j);
    i += order <= 0 ? 1 : 0;
    j += order >= 0 ? 1 : 0;
  }
  if (matches.pairs.size() < kFewestCameras) return {};
  WorldShift shift;
  try {
    shift.earlier_from_now = AlignTrajectories(after, before, matches);
  } catch (const Error&) {
    return {};
  }
  const ColmapModel moved = Transformed(now, shift.earlier_from_now);
  std::map<uint32_t, Lens> lenses_before, lenses_now;
  for (const auto& [id, camera] : earlier.cameras) lenses_before.emplace(id, camera);
  for (const auto& [id, camera] : now.cameras) lenses_now.emplace(id, camera);
  std::vector<double> medians;
  for (const auto& [id, image] : earlier.images) {
    const auto known = image_now.find(image.name);
    if (known == image_now.end()) continue;
    const ColmapImage& later = moved.images.at(known->second->id);
    std::vector<double> distances;
    for (const ColmapObservation& observation : image.observations) {
      const auto point = earlier.points.find(uint64_t(observation.point_id));
      if (observation.point_id < 0 || point == earlier.points.end()) continue;
      const auto then = Project(image, lenses_before.at(image.camera_id), point->second.position);
      const auto there = Project(later, lenses_now.at(later.camera_id), point->second.position);
      if (then) distances.push_back(there ? (*there - *then).norm() : HUGE_VAL);
    }
    if (!distances.empty()) medians.push_back(Median(distances));
  }
  if (medians.size() < kFewestCameras) return {};
  shift.median_px = Median(medians);
  shift.largest_px = *std::max_element(medians.begin(), medians.end());
  return shift;
}

ColmapModel Transformed(const ColmapModel& model, const Matrix4d& similarity) {
  const double scale = std::cbrt(similarity.topLeftCorner<3, 3>().determinant());
  const Eigen::Quaterniond rotation(Matrix3d(similarity.topLeftCorner<3, 3>() / scale));
  ColmapModel moved = model;
  for (auto& [id, image] : moved.images) {
    const Vector3d center = (similarity * image.Center().homogeneous()).head<3>();
    image.rotation = (image.rotation * rotation.conjugate()).normalized();
    image.translation = -(image.rotation * center);
  }
  for (auto& [id, point] : moved.points) point.position = (similarity * point.position.homogeneous()).head<3>();
  return moved;
}

double MeanError(const ColmapModel& model) {
  double sum = 0;
  for (const auto& [id, point] : model.points) sum += point.error_px;
  return model.points.empty() ? 0 : sum / double(model.points.size());
}

}  // namespace nrff
