// Cameras, alignment and normalisation, in double: closed forms, round trips, and laws that hold for any world.

#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <cmath>
#include <numbers>
#include <random>
#include <string>
#include <vector>

#include "pipeline/error.h"
#include "sfm/distortion.h"
#include "sfm/normalise.h"
#include "sfm/trajectory_errors.h"
#include "tests/stability/table.h"

namespace nrff::stability {
namespace {

using Eigen::Matrix3d;
using Eigen::Matrix4d;
using Eigen::Quaterniond;
using Eigen::Vector2d;
using Eigen::Vector3d;

constexpr double kU = kUnit<double>;

// px → ray → px. The inverse is good to 1e-12 in u and v, which the focal length turns into px; a pixel itself is off
// by u of its coordinate, the principal point included.
void HoldRoundTrip(const char* condition, const ColmapCamera& camera) {
  const Lens lens(camera);
  Worst worst;
  for (int y = 0; y <= 8; ++y) {
    for (int x = 0; x <= 8; ++x) {
      const Vector2d px(camera.width * x / 8., camera.height * y / 8.);
      const auto uv = lens.CameraFromImage(px);
      if (!uv) continue;  // no ray reaches it: said, not guessed
      const auto again = lens.ImageFromCamera(*uv);
      ASSERT_TRUE(again);
      const double slope = 1 + uv->squaredNorm();  // of rays far from the axis
      worst.Add((*again - px).norm(),
                lens.focal_px().maxCoeff() * 4e-12 * slope + 64 * kU * (lens.principal_point_px().norm() + px.norm()));
    }
  }
  worst.Hold("cameras", "px → ray → px", condition);
}

TEST(Cameras, RoundTrips) {
  const int w = 640, h = 480;
  HoldRoundTrip("OPENCV", {1, CameraModel::kOpenCV, w, h, {500, 505, 318, 243, -0.2, 0.06, 0.002, -0.003}});
  HoldRoundTrip("OPENCV past its fold", {1, CameraModel::kOpenCV, w, h, {300, 300, 320, 240, -0.35, 0, 0, 0}});
  HoldRoundTrip("principal point outside", {1, CameraModel::kPinhole, w, h, {500, 505, -4000, 9000}});
  HoldRoundTrip("focal length 1e6", {1, CameraModel::kSimpleRadial, w, h, {1e6, 320, 240, 0.1}});
  HoldRoundTrip("focal length 1e-3", {1, CameraModel::kPinhole, w, h, {1e-3, 1e-3, 320, 240}});
  HoldRoundTrip("fisheye, 160° across", {1, CameraModel::kOpenCVFisheye, w, h, {230, 230, 320, 240, 0, 0, 0, 0}});
  HoldRoundTrip("fisheye, 180° and more across",
                {1, CameraModel::kOpenCVFisheye, w, h, {150, 150, 320, 240, 0, 0, 0, 0}});
}

// The ideal fisheye's own form: a pixel at distance r from the principal point looks along r/f off the axis.
TEST(Cameras, FisheyeIsTheEquidistantProjection) {
  const Lens lens({1, CameraModel::kOpenCVFisheye, 1000, 1000, {300, 300, 500, 500, 0, 0, 0, 0}});
  Worst worst;
  bool answered_beyond = false;
  std::vector<double> radii;
  for (int power = -9; power < 0; ++power) radii.push_back(std::pow(10, power));
  for (int pixel = 1; pixel < 500; pixel += 7) radii.push_back(pixel);
  for (const double r : radii) {
    const double theta = r / 300;
    const auto uv = lens.CameraFromImage({500 + r, 500});
    if (theta > 0.5 * std::numbers::pi) answered_beyond = answered_beyond || uv.has_value();
    if (!uv || theta > 0.5 * std::numbers::pi) continue;
    const double expected = std::tan(theta);
    // The pixel's own rounding (u·500 px) through the tangent's slope, and the inverse's tolerance.
    worst.Add(std::abs((*uv)[0] - expected), (1 + expected * expected) * (4e-12 + 64 * kU * 500 / 300));
  }
  worst.Hold("cameras", "fisheye against tan(r/f)", "to the radius that is answered");
  EXPECT_FALSE(answered_beyond) << "a ray at right angles or behind the camera has no (u, v)";
}

Trajectory RandomTrajectory(int n, unsigned seed, const Vector3d& spread) {
  std::mt19937 random(seed);
  std::normal_distribution<double> normal;
  Trajectory trajectory;
  for (int i = 0; i < n; ++i) {
    const Quaterniond rotation(normal(random), normal(random), normal(random), normal(random));
    const Vector3d center(normal(random), normal(random), normal(random));
    trajectory.push_back({"photo" + std::to_string(1000 + i), rotation.normalized(), spread.cwiseProduct(center)});
  }
  return trajectory;
}

Matrix4d Similarity(double scale, const Quaterniond& rotation, const Vector3d& translation) {
  Matrix4d matrix = Matrix4d::Identity();
  matrix.topLeftCorner<3, 3>() = scale * rotation.toRotationMatrix();
  matrix.topRightCorner<3, 1>() = translation;
  return matrix;
}

// Centres lose log10(offset / extent) of their digits before the alignment sees them.
TEST(Alignment, ComesBackWhateverTheWorld) {
  const Quaterniond turn = Quaterniond(0.3, -0.5, 0.7, 0.2).normalized();
  const struct {
    const char* condition;
    Vector3d spread;
    double scale, offset;
  } cases[] = {{"scale 1e-6", {1, 1, 1}, 1e-6, 0},         {"scale 1e6", {1, 1, 1}, 1e6, 0},
               {"1e7 from the origin", {1, 1, 1}, 1, 1e7}, {"coplanar centres", {1, 1, 0}, 1, 0},
               {"centres on a line", {1, 0, 0}, 1, 0},     {"centres almost on a line", {1, 1e-9, 1e-9}, 1, 0}};
  for (const auto& c : cases) {
    const Trajectory truth = RandomTrajectory(25, 5, c.spread);
    const Trajectory moved = Transformed(truth, Similarity(c.scale, turn, Vector3d::Constant(c.offset)));
    const Trajectory back = Transformed(moved, AlignTrajectories(moved, truth, MatchPoses(moved, truth)));
    double most = 0;
    for (size_t i = 0; i < truth.size(); ++i) most = std::max(most, (back[i].center - truth[i].center).norm());
    Hold("alignment", "centres after a similarity and back, of their extent", c.condition, most,
         1e-10 + 100 * kU * c.offset / c.scale);
  }
}

TEST(Alignment, ToldApartWhereItCannotBe) {
  const Trajectory truth = RandomTrajectory(6, 7, {1, 1, 1});
  double refused = 0;
  for (const int n : {1, 6}) {  // one camera; all at one point
    Trajectory estimated(truth.begin(), truth.begin() + n);
    for (TrajectoryPose& pose : estimated) pose.center = {1, 2, 3};
    try {
      AlignTrajectories(estimated, truth, MatchPoses(estimated, truth));
    } catch (const Error& error) {
      refused += error.code() == ExitCode::kInput;
    }
  }
  Hold("alignment", "cases not refused", "one camera; coincident centres", 2 - refused, 0);

  Trajectory mirrored = truth;
  for (TrajectoryPose& pose : mirrored) pose.center[2] = -pose.center[2];
  const Matrix4d similarity = AlignTrajectories(mirrored, truth, MatchPoses(mirrored, truth));
  const Matrix3d linear = similarity.topLeftCorner<3, 3>();
  const double scale = std::cbrt(linear.determinant());
  Hold("alignment", "a mirrored world gets a rotation, no mirror", "‖RᵀR − 1‖, NaN with a negative determinant",
       (linear.transpose() * linear / (scale * scale) - Matrix3d::Identity()).norm() + (scale > 0 ? 0 : NAN), 64 * kU);
}

PosedCamera LookAt(const Vector3d& center, const Vector3d& target) {
  const Vector3d z = (target - center).normalized(), x = z.cross(Vector3d::UnitZ()).normalized();
  PosedCamera camera;
  camera.name = "photo";
  camera.world_from_camera << x, z.cross(x), z;
  camera.center = center;
  camera.half_field = 0.4;
  return camera;
}

// The same scene for any similarity of the world, to the digits that the world leaves.
TEST(Normalisation, IsTheSameWhateverTheWorld) {
  NormaliseInput input;
  std::mt19937 random(3);
  std::uniform_real_distribution<double> coordinate(-0.8, 0.8);
  for (int i = 0; i < 24; ++i) {
    const double angle = 2 * std::numbers::pi * i / 24;
    input.cameras.push_back(LookAt({4 * std::cos(angle), 4 * std::sin(angle), i % 2 ? 1.0 : 2.0}, Vector3d::Zero()));
  }
  for (int i = 0; i < 500; ++i) input.points.emplace_back(coordinate(random), coordinate(random), coordinate(random));
  const auto with_depths = [](NormaliseInput in) {
    for (const PosedCamera& camera : in.cameras) {
      for (const Vector3d& point : in.points) in.depths.push_back((point - camera.center).norm());
    }
    return in;
  };
  const Normalisation expected = Normalise(with_depths(input));
  const auto scene = [](const Normalisation& normalisation, const Vector3d& world) -> Vector3d {
    return normalisation.scene_from_world.topLeftCorner<3, 3>() * world +
           normalisation.scene_from_world.topRightCorner<3, 1>();
  };
  const Quaterniond turn = Quaterniond(0.9, 0.1, -0.3, 0.2).normalized();
  for (const auto& [condition, scale, offset] :
       {std::tuple("scale 1e-6", 1e-6, 0.0), {"scale 1e6", 1e6, 0.0}, {"1e7 from the origin", 1.0, 1e7}}) {
    NormaliseInput moved = input;
    const Vector3d shift = Vector3d::Constant(offset);
    for (PosedCamera& camera : moved.cameras) {
      camera.center = scale * (turn * camera.center) + shift;
      camera.world_from_camera = turn.toRotationMatrix() * camera.world_from_camera;
    }
    for (Vector3d& point : moved.points) point = scale * (turn * point) + shift;
    const Normalisation actual = Normalise(with_depths(moved));
    double most = 0;
    for (size_t i = 0; i < input.points.size(); ++i) {
      most = std::max(most, (scene(actual, moved.points[i]) - scene(expected, input.points[i])).norm());
    }
    Hold("normalisation", "points in the scene frame", condition, most, 1e3 * kU * (1 + offset / scale));
  }
}

TEST(Normalisation, DegenerateCapturesHaveAFiniteScene) {
  const struct {
    const char* condition;
    std::vector<Vector3d> centers;
  } cases[] = {{"one camera", {{1, 2, 3}}},
               {"coincident cameras", {{1, 2, 3}, {1, 2, 3}, {1, 2, 3}}},
               {"cameras on a line", {{0, 0, 0}, {1, 0, 0}, {2, 0, 0}, {3, 0, 0}}},
               {"coplanar cameras", {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {1, 1, 0}}}};
  for (const auto& c : cases) {
    NormaliseInput input;
    for (const Vector3d& center : c.centers) input.cameras.push_back(LookAt(center, center + Vector3d(0.1, 1, 0)));
    const Normalisation normalisation = Normalise(input);
    const bool sound = normalisation.scene_from_world.allFinite() && normalisation.scale > 0 &&
                       std::isfinite(normalisation.scale) && normalisation.near > 0 &&
                       normalisation.far > normalisation.near &&
                       (normalisation.aabb_max - normalisation.aabb_min).minCoeff() > 0;
    Hold("normalisation", "captures without a finite, positive scene", c.condition, sound ? 0 : 1, 0);
  }
}

}  // namespace
}  // namespace nrff::stability
