#include "sfm/sparse_depth.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <set>

namespace nrff {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

constexpr double kLeastError_px = 0.5;        // errors of a few residuals can be small by chance
constexpr double kLargestUncertainty = 0.05;  // of the distance

Vector3d CenterOf(const View& view) {
  return {view.scene_from_camera[3], view.scene_from_camera[7], view.scene_from_camera[11]};
}

}  // namespace

std::vector<SparseDepth> MeasureSparseDepths(const ColmapModel& model,
                                             const std::map<uint32_t, uint32_t>& view_of_image,
                                             const std::vector<double>& error_scale, const Scene& scene,
                                             const Eigen::Matrix4d& scene_from_world) {
  std::vector<SparseDepth> depths;
  for (const auto& [id, point] : model.points) {
    const Vector3d position = (scene_from_world * point.position.homogeneous()).head<3>();
    std::set<uint32_t> views;
    for (const auto& [image_id, observation] : point.track) {
      const auto view = view_of_image.find(image_id);
      if (view != view_of_image.end() && scene.views[view->second].split == Split::kTrain) views.insert(view->second);
    }
    if (views.size() < 2) continue;
    Matrix3d information = Matrix3d::Zero();
    double error_px = kLeastError_px;
    for (const uint32_t v : views) {
      const Vector3d ray = position - CenterOf(scene.views[v]);
      const double distance = ray.norm(), focal_px = std::sqrt(scene.views[v].fx * scene.views[v].fy);
      const Vector3d d = ray / distance;
      information += (focal_px / distance) * (focal_px / distance) * (Matrix3d::Identity() - d * d.transpose());
      error_px = std::max(error_px, point.error_px * error_scale[v]);
    }
    const Eigen::LLT<Matrix3d> cholesky(information);
    if (cholesky.info() != Eigen::Success) continue;  // seen along one line only
    for (const uint32_t v : views) {
      const Vector3d ray = position - CenterOf(scene.views[v]);
      const double distance = ray.norm();
      const Vector3d d = ray / distance;
      const double sigma = error_px * std::sqrt(d.dot(cholesky.solve(d)));
      if (!(sigma > 0) || !(sigma <= kLargestUncertainty * distance)) continue;
      depths.push_back({v, {float(position.x()), float(position.y()), float(position.z())}, float(sigma)});
    }
  }
  return depths;
}

}  // namespace nrff
