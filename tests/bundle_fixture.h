// Synthetic COLMAP models whose true cameras and points are known, for tests of bundle refinement.
#pragma once

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <functional>
#include <random>
#include <string>
#include <vector>

#include "sfm/colmap_model.h"
#include "sfm/distortion.h"

namespace nrff {

// One of each model, with distortion as real lenses have it, 640×480.
inline std::vector<ColmapCamera> CamerasOfAllModels() {
  const auto camera = [](CameraModel model, std::vector<double> params) {
    return ColmapCamera{1, model, 640, 480, std::move(params)};
  };
  return {camera(CameraModel::kSimplePinhole, {400, 320, 240}),
          camera(CameraModel::kPinhole, {400, 405, 318, 243}),
          camera(CameraModel::kSimpleRadial, {400, 318, 243, -0.08}),
          camera(CameraModel::kRadial, {400, 318, 243, -0.1, 0.02}),
          camera(CameraModel::kOpenCV, {400, 405, 318, 243, -0.1, 0.02, 0.002, -0.003}),
          camera(CameraModel::kOpenCVFisheye, {300, 305, 318, 243, -0.02, 0.01, -0.004, 0.001}),
          camera(CameraModel::kFullOpenCV, {150, 155, 318, 243, 3, 1, 0.002, -0.003, 0.1, 2, 1, 0.3}),
          camera(CameraModel::kFov, {400, 405, 318, 243, 0.9}),
          camera(CameraModel::kSimpleRadialFisheye, {300, 318, 243, -0.03}),
          camera(CameraModel::kRadialFisheye, {300, 318, 243, -0.03, 0.005}),
          camera(CameraModel::kThinPrismFisheye,
                 {300, 305, 318, 243, -0.02, 0.01, 0.001, -0.002, -0.003, 0.001, 0.002, -0.001})};
}

inline Eigen::Vector3d NormalVector(std::mt19937& random) {
  std::normal_distribution<double> normal;
  const double x = normal(random), y = normal(random);
  return {x, y, normal(random)};
}

inline std::vector<Eigen::Vector3d> PointsInBall(int n, double radius, unsigned seed) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<double> coordinate(-radius, radius);
  std::vector<Eigen::Vector3d> points;
  while (int(points.size()) < n) {
    const double x = coordinate(random), y = coordinate(random);
    const Eigen::Vector3d point(x, y, coordinate(random));
    if (point.norm() < radius) points.push_back(point);
  }
  return points;
}

inline void AddImage(ColmapModel& model, uint32_t camera_id, const Eigen::Matrix3d& world_from_camera,
                     const Eigen::Vector3d& center) {
  const auto id = uint32_t(model.images.size() + 1);
  ColmapImage& image = model.images[id];
  image.id = id;
  image.camera_id = camera_id;
  image.name = "photo" + std::to_string(id) + ".jpg";
  image.rotation = Eigen::Quaterniond(Eigen::Matrix3d(world_from_camera.transpose()));
  image.translation = -(image.rotation * center);
}

inline Eigen::Matrix3d LookingAt(const Eigen::Vector3d& center, const Eigen::Vector3d& target, double roll) {
  const Eigen::Vector3d z = (target - center).normalized();
  const Eigen::Vector3d x =
      z.cross(std::abs(z.z()) > 0.9 ? Eigen::Vector3d::UnitX() : Eigen::Vector3d::UnitZ()).normalized();
  Eigen::Matrix3d world_from_camera;
  world_from_camera << x, z.cross(x), z;
  return world_from_camera * Eigen::AngleAxisd(roll, Eigen::Vector3d::UnitZ()).toRotationMatrix();
}

// Every image observes every point that lies within it, without noise; earlier observations go.
inline void Observe(ColmapModel& model) {
  for (auto& [id, point] : model.points) point.track.clear();
  for (auto& [id, image] : model.images) {
    const ColmapCamera& camera = model.cameras.at(image.camera_id);
    const Lens lens(camera);
    image.observations.clear();
    for (auto& [point_id, point] : model.points) {
      const Eigen::Vector3d in_camera = image.rotation * (point.position - image.Center());
      if (!(in_camera.z() > 0)) continue;
      const auto px = lens.ImageFromCamera(in_camera.hnormalized());
      if (!px || px->x() < 0 || px->y() < 0 || px->x() > camera.width || px->y() > camera.height) continue;
      point.track.emplace_back(id, uint32_t(image.observations.size()));
      image.observations.push_back({px->x(), px->y(), int64_t(point_id)});
    }
  }
}

inline void AddPoints(ColmapModel& model, const std::vector<Eigen::Vector3d>& positions) {
  for (const Eigen::Vector3d& position : positions) model.points[model.points.size() + 1].position = position;
}

// `n` cameras on a ring of radius 4 about a ball of radius 3 with `n_points` points, at several heights and rolls so
// that they fix their lens.
inline ColmapModel Ring(const ColmapCamera& camera, int n = 12, int n_points = 150) {
  ColmapModel model;
  model.cameras[camera.id] = camera;
  for (int i = 0; i < n; ++i) {
    const double angle = 2 * M_PI * i / n;
    const Eigen::Vector3d center(4 * std::cos(angle), 4 * std::sin(angle), 1.5 * (i % 3) - 1);
    AddImage(model, camera.id, LookingAt(center, {0.1 * (i % 2), 0.2, 0.1}, 0.7 * (i % 4)), center);
  }
  AddPoints(model, PointsInBall(n_points, 3, 7));
  Observe(model);
  return model;
}

// Poses by `amount` of the ring's radius and radians, points by as much, lenses by `amount` of what they do to a pixel.
inline ColmapModel Perturbed(ColmapModel model, double amount, unsigned seed = 3) {
  std::mt19937 random(seed);
  for (auto& [id, image] : model.images) {
    const Eigen::Vector3d center = image.Center() + 4 * amount * NormalVector(random) / std::sqrt(3.0);
    const Eigen::Vector3d turn = amount * NormalVector(random) / std::sqrt(3.0);
    image.rotation = Eigen::Quaterniond(Eigen::AngleAxisd(turn.norm(), turn.normalized())) * image.rotation;
    image.translation = -(image.rotation * center);
  }
  for (auto& [id, point] : model.points) point.position += 4 * amount * NormalVector(random) / std::sqrt(3.0);
  for (auto& [id, camera] : model.cameras) {
    for (double& param : camera.params) param += amount * (param > 1 ? param : 0.1);
  }
  return model;
}

inline void AddNoise(ColmapModel& model, double sigma_px, unsigned seed) {
  std::mt19937 random(seed);
  for (auto& [id, image] : model.images) {
    for (ColmapObservation& observation : image.observations) {
      const Eigen::Vector3d noise = sigma_px * NormalVector(random);
      observation.x += noise.x();
      observation.y += noise.y();
    }
  }
}

// What the lens of image `id` of `n` (no multiple of 5) is zoomed by: 1 − range/2 to 1 + range/2.
inline double ZoomOf(uint32_t id, int n, double range) {
  return 1 + range * (double(5 * id % uint32_t(n)) / (n - 1) - 0.5);
}

// A ring seen through a zoom lens, as if it had not been zoomed by `zoom_of` for each image.
inline ColmapModel ZoomedRing(const ColmapCamera& camera, int n, int n_points, double noise_px,
                              const std::function<double(uint32_t id)>& zoom_of) {
  ColmapModel model = Ring(camera, n, n_points);
  for (auto& [id, image] : model.images) {
    image.camera_id = 100 + id;
    ColmapCamera& zoomed = model.cameras[image.camera_id] = camera;
    zoomed.params[0] *= zoom_of(id);
  }
  Observe(model);
  AddNoise(model, noise_px, 5);
  for (auto& [id, image] : model.images) image.camera_id = camera.id;
  model.cameras = {{camera.id, camera}};
  return model;
}

inline ColmapModel ZoomedRing(const ColmapCamera& camera, int n, int n_points, double noise_px, double range) {
  return ZoomedRing(camera, n, n_points, noise_px, [&](uint32_t id) { return ZoomOf(id, n, range); });
}

inline ColmapModel Moved(ColmapModel model, double scale, const Eigen::Quaterniond& rotation,
                         const Eigen::Vector3d& translation) {
  for (auto& [id, image] : model.images) {
    const Eigen::Vector3d center = scale * (rotation * image.Center()) + translation;
    image.rotation = image.rotation * rotation.conjugate();
    image.translation = -(image.rotation * center);
  }
  for (auto& [id, point] : model.points) point.position = scale * (rotation * point.position) + translation;
  return model;
}

// After the similarity that takes the centres and points of `model` to those of `truth` by least squares.
struct ModelErrors {
  double position = 0;    // largest, of centres, over the rms distance of the true ones from their mean
  double point = 0;       // largest, over the same
  double rotation = 0;    // largest, radians
  double intrinsics = 0;  // largest, of where rays of the whole image are seen, over its width
};

inline ModelErrors Compare(const ColmapModel& model, const ColmapModel& truth) {
  const auto n = Eigen::Index(truth.images.size()), n_points = Eigen::Index(truth.points.size());
  Eigen::Matrix3Xd from(3, n + n_points), to(3, n + n_points);
  Eigen::Index column = 0;
  for (const auto& [id, image] : truth.images) {
    from.col(column) = model.images.at(id).Center();
    to.col(column++) = image.Center();
  }
  for (const auto& [id, point] : truth.points) {
    from.col(column) = model.points.at(id).position;
    to.col(column++) = point.position;
  }
  const Eigen::Matrix4d similarity = Eigen::umeyama(from, to);
  const Eigen::Matrix3d linear = similarity.topLeftCorner<3, 3>();
  const Eigen::Matrix3Xd aligned = (linear * from).colwise() + similarity.topRightCorner<3, 1>();
  const Eigen::Matrix3Xd centers = to.leftCols(n);
  const double radius = (centers.colwise() - centers.rowwise().mean()).norm() / std::sqrt(double(n));
  const Eigen::VectorXd distances = (aligned - to).colwise().norm().transpose() / radius;
  ModelErrors errors;
  errors.position = distances.head(n).maxCoeff();
  errors.point = distances.tail(n_points).maxCoeff();
  const Eigen::Matrix3d turn = linear / std::cbrt(linear.determinant());
  for (const auto& [id, image] : truth.images) {
    const Eigen::Matrix3d error = model.images.at(id).rotation.toRotationMatrix() * turn.transpose() *
                                  image.rotation.toRotationMatrix().transpose();
    errors.rotation = std::max(errors.rotation, (error - Eigen::Matrix3d::Identity()).norm() / std::sqrt(2.0));
  }
  for (const auto& [id, camera] : truth.cameras) {
    const Lens lens(model.cameras.at(id)), true_lens(camera);
    for (int i = 0; i < 81; ++i) {
      const int column = i % 9, row = i / 9;
      const auto ray = true_lens.CameraFromImage({camera.width * column / 8.0, camera.height * row / 8.0});
      if (!ray) continue;
      const auto px = lens.ImageFromCamera(*ray), true_px = true_lens.ImageFromCamera(*ray);
      errors.intrinsics = std::max(errors.intrinsics, px ? (*px - *true_px).norm() / camera.width : HUGE_VAL);
    }
  }
  return errors;
}

}  // namespace nrff
