#include "sfm/sparse_depth.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <optional>

namespace nrff {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

constexpr double kLeastError_px = 0.5;        // few residuals can be small by chance
constexpr double kLargestUncertainty = 0.05;  // of the distance
constexpr int kIterations = 4;                // the distances that weigh the rays converge at once

struct Sighting {
  uint32_t view;
  Vector3d center, ray;  // scene frame; ray: unit
  double focal_px;

  // (f/D)² (I − d dᵀ) for a point at `position`.
  Matrix3d Information(const Vector3d& position) const {
    const double px_per_unit = focal_px / (position - center).norm();
    return px_per_unit * px_per_unit * (Matrix3d::Identity() - ray * ray.transpose());
  }
};

Sighting See(const View& view, uint32_t index, const ColmapObservation& observation) {
  Matrix3d rotation;
  Vector3d center;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) rotation(i, j) = view.scene_from_camera[4 * size_t(i) + size_t(j)];
    center[i] = view.scene_from_camera[4 * size_t(i) + 3];
  }
  const Vector3d in_camera((observation.x - view.cx) / view.fx, (observation.y - view.cy) / view.fy, 1);
  return {index, center, (rotation * in_camera).normalized(), std::sqrt(view.fx * view.fy)};
}

// In order of views; one per view.
std::vector<Sighting> TrainingSightings(const ColmapModel& model, const ColmapPoint& point,
                                        const std::map<uint32_t, uint32_t>& view_of_image, const Scene& scene) {
  std::map<uint32_t, Sighting> by_view;
  for (const auto& [image_id, index] : point.track) {
    const auto view = view_of_image.find(image_id);
    if (view == view_of_image.end() || scene.views[view->second].split != Split::kTrain) continue;
    const ColmapObservation& observation = model.images.at(image_id).observations[index];
    by_view.emplace(view->second, See(scene.views[view->second], view->second, observation));
  }
  std::vector<Sighting> sightings;
  sightings.reserve(by_view.size());
  for (const auto& [view, sighting] : by_view) sightings.push_back(sighting);
  return sightings;
}

struct Triangulation {
  Vector3d position;
  Matrix3d covariance;  // for a residual of 1 px
  double error_px;
};

// Nothing where the rays do not fix a point in front of all views.
std::optional<Triangulation> Triangulate(const std::vector<Sighting>& sightings, const Vector3d& start) {
  Triangulation result{start, Matrix3d::Zero(), 0};
  for (int iteration = 0; iteration < kIterations; ++iteration) {
    Matrix3d information = Matrix3d::Zero();
    Vector3d right = Vector3d::Zero();
    for (const Sighting& sighting : sightings) {
      const Matrix3d across = sighting.Information(result.position);
      information += across;
      right += across * sighting.center;
    }
    const Eigen::LLT<Matrix3d> cholesky(information);
    if (cholesky.info() != Eigen::Success) return {};
    result.position = cholesky.solve(right);
    result.covariance = cholesky.solve(Matrix3d::Identity());
    if (!result.position.allFinite()) return {};
  }
  double squared_px = 0;
  for (const Sighting& sighting : sightings) {
    const Vector3d offset = result.position - sighting.center;
    if (!(offset.dot(sighting.ray) > 0)) return {};
    squared_px += offset.dot(sighting.Information(result.position) * offset);
  }
  result.error_px = std::max(kLeastError_px, std::sqrt(squared_px / (2 * double(sightings.size()) - 3)));
  return result;
}

}  // namespace

std::vector<SparseDepth> MeasureSparseDepths(const ColmapModel& model,
                                             const std::map<uint32_t, uint32_t>& view_of_image, const Scene& scene,
                                             const Eigen::Matrix4d& scene_from_world) {
  std::vector<SparseDepth> depths;
  for (const auto& [id, point] : model.points) {
    const std::vector<Sighting> sightings = TrainingSightings(model, point, view_of_image, scene);
    if (sightings.size() < 2) continue;
    const auto triangulation = Triangulate(sightings, (scene_from_world * point.position.homogeneous()).head<3>());
    if (!triangulation) continue;
    const Vector3d& position = triangulation->position;
    for (const Sighting& sighting : sightings) {
      const Vector3d offset = position - sighting.center;
      const Vector3d direction = offset.normalized();
      const double sigma = triangulation->error_px * std::sqrt(direction.dot(triangulation->covariance * direction));
      if (!(sigma > 0) || !(sigma <= kLargestUncertainty * offset.norm())) continue;
      depths.push_back({sighting.view, {float(position.x()), float(position.y()), float(position.z())}, float(sigma)});
    }
  }
  return depths;
}

}  // namespace nrff
