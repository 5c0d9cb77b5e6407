#include "sfm/earlier_frame.h"

#include <algorithm>
#include <cmath>

#include "pipeline/error.h"
#include "pipeline/extension.h"
#include "pipeline/files.h"

namespace nrff {

using Eigen::Matrix4d;
using Eigen::Vector3d;

EarlierFrame ReadEarlierFrame(const std::filesystem::path& dir) {
  const std::filesystem::path path = dir / kSceneFile;
  const std::string where = EscapePath(path);
  const Json json = ReadJson(path);
  CheckSchemaVersion(json, kSceneSchemaVersion, where);
  EarlierFrame frame;
  const auto matrix = Get<Mat4>(json, "scene_from_world", where);
  frame.scene_from_world = Eigen::Map<const Eigen::Matrix<double, 4, 4, Eigen::RowMajor>>(matrix.data());
  frame.unbounded = Get<bool>(json, "unbounded", where);
  const auto low = Get<Vec3>(json, "aabb_min", where), high = Get<Vec3>(json, "aabb_max", where);
  frame.aabb_min = Vector3d(low.data());
  frame.aabb_max = Vector3d(high.data());
  frame.near = Get<double>(json, "near", where);
  frame.far = Get<double>(json, "far", where);
  const double volume = frame.scene_from_world.topLeftCorner<3, 3>().determinant();
  if (!frame.scene_from_world.allFinite() || !(volume > 0) || !((frame.aabb_max - frame.aabb_min).minCoeff() > 0)) {
    throw CorruptError(where + ": the frame is not finite or empty; run with --force to make everything anew");
  }
  for (const Json& view : Get<std::vector<Json>>(json, "views", where)) {
    const auto gain = Get<Vec3>(view, "colour_gain", where);
    if (!std::all_of(gain.begin(), gain.end(), [](double g) { return g > 0 && std::isfinite(g); })) {
      throw CorruptError(where +
                         ": a colour gain is not finite and positive; run with --force to make everything anew");
    }
    if (Get<std::string>(view, "split", where) == "train") {
      frame.training_gains[Get<std::string>(view, "id", where)] = gain;
    }
  }
  return frame;
}

Decision DecideFrame(const EarlierFrame& earlier, const Normalisation& anew, const std::vector<Vector3d>& points) {
  const Matrix4d earlier_from_anew = earlier.scene_from_world * anew.scene_from_world.inverse();
  const double scale = std::cbrt(earlier_from_anew.topLeftCorner<3, 3>().determinant());
  size_t n_outside = 0;
  for (const Vector3d& point : points) {
    const Vector3d p = (earlier.scene_from_world * point.homogeneous()).head<3>();
    const bool inside = (p.array() >= earlier.aabb_min.array()).all() && (p.array() <= earlier.aabb_max.array()).all();
    n_outside += inside ? 0 : 1;
  }
  const Vector3d centre = (earlier_from_anew * ((anew.aabb_min + anew.aabb_max) / 2).homogeneous()).head<3>();
  const double shift = (centre - (earlier.aabb_min + earlier.aabb_max) / 2).norm();
  return needs::FrameAnew(earlier.unbounded == anew.unbounded, anew.unbounded, shift, scale,
                          points.empty() ? 0 : double(n_outside) / double(points.size()));
}

Normalisation InFrame(const EarlierFrame& earlier, const Normalisation& anew) {
  Normalisation n = anew;
  n.scene_from_world = earlier.scene_from_world;
  n.scale = std::cbrt(earlier.scene_from_world.topLeftCorner<3, 3>().determinant());
  n.aabb_min = earlier.aabb_min;
  n.aabb_max = earlier.aabb_max;
  const double ratio = n.scale / anew.scale;
  n.near = std::min(earlier.near, ratio * anew.near);
  n.far = std::max(earlier.far, ratio * anew.far);
  return n;
}

void KeepExposure(const EarlierFrame& earlier, Scene& scene) {
  Vec3 log_ratio{};
  int n_common = 0;
  for (const View& view : scene.views) {
    const auto before = earlier.training_gains.find(view.id);
    if (view.split != Split::kTrain || before == earlier.training_gains.end()) continue;
    for (size_t c = 0; c < 3; ++c) log_ratio[c] += std::log(before->second[c] / view.colour_gain[c]);
    ++n_common;
  }
  if (n_common == 0) return;
  for (View& view : scene.views) {
    if (view.split != Split::kTrain) continue;  // held-out views keep a gain of 1
    for (size_t c = 0; c < 3; ++c) view.colour_gain[c] *= std::exp(log_ratio[c] / n_common);
  }
}

}  // namespace nrff
