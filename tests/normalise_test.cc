// Normalisation: what the scene frame promises, on synthetic captures of every kind.
#include "sfm/normalise.h"

#include <gtest/gtest.h>

#include <Eigen/LU>
#include <cmath>
#include <limits>
#include <random>

#include "pipeline/error.h"

namespace nrff {
namespace {

using Eigen::AngleAxisd;
using Eigen::Matrix3d;
using Eigen::Matrix4d;
using Eigen::Vector3d;

PosedCamera LookAt(const Vector3d& center, const Vector3d& target, const Vector3d& up = Vector3d::UnitZ()) {
  const Vector3d z = (target - center).normalized();
  const Vector3d x = z.cross(up).normalized();
  PosedCamera camera;
  camera.name = "photo";
  camera.world_from_camera << x, z.cross(x), z;
  camera.center = center;
  camera.half_field = 0.4;
  return camera;
}

std::vector<Vector3d> Cloud(int n, const Vector3d& center, double radius, unsigned seed = 3) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<double> coordinate(-radius, radius);
  std::vector<Vector3d> points;
  points.reserve(size_t(n));
  for (int i = 0; i < n; ++i)
    points.emplace_back(center + Vector3d(coordinate(random), coordinate(random), coordinate(random)));
  return points;
}

void AddDepths(NormaliseInput& input) {
  for (const PosedCamera& camera : input.cameras) {
    for (const Vector3d& point : input.points) input.depths.push_back((point - camera.center).norm());
  }
}

const Vector3d kObject(3, -2, 5);

// Cameras on two rings around an object, looking at it; points on it and far behind it.
NormaliseInput Turntable() {
  NormaliseInput input;
  for (int i = 0; i < 24; ++i) {
    const double angle = 2 * M_PI * i / 24;
    input.cameras.push_back(
        LookAt(kObject + Vector3d(4 * std::cos(angle), 4 * std::sin(angle), i % 2 ? 1.0 : 2.0), kObject));
  }
  input.points = Cloud(500, kObject, 0.8);
  for (const Vector3d& point : Cloud(200, kObject, 40)) input.points.push_back(point);
  AddDepths(input);
  return input;
}

// Cameras side by side, all looking along +y at a wall.
NormaliseInput SideBySide() {
  NormaliseInput input;
  for (int i = 0; i < 8; ++i) input.cameras.push_back(LookAt({0.5 * i, 0, 0}, {0.5 * i, 10, 0}));
  input.points = Cloud(400, {2, 10, 0}, 2);
  AddDepths(input);
  return input;
}

NormaliseInput Transformed(NormaliseInput input, double scale, const Matrix3d& rotation, const Vector3d& translation) {
  for (PosedCamera& camera : input.cameras) {
    camera.center = scale * (rotation * camera.center) + translation;
    camera.world_from_camera = rotation * camera.world_from_camera;
  }
  for (Vector3d& point : input.points) point = scale * (rotation * point) + translation;
  for (double& depth : input.depths) depth *= scale;
  return input;
}

Vector3d ToScene(const Normalisation& n, const Vector3d& world) {
  return (n.scene_from_world * world.homogeneous()).head<3>();
}

void ExpectSimilarity(const Normalisation& n) {
  ASSERT_TRUE(n.scene_from_world.allFinite());
  ASSERT_GT(n.scale, 0);
  const Matrix3d rotation = n.scene_from_world.topLeftCorner<3, 3>() / n.scale;
  EXPECT_LT((rotation * rotation.transpose() - Matrix3d::Identity()).norm(), 1e-9);
  EXPECT_NEAR(rotation.determinant(), 1, 1e-9);
  EXPECT_EQ(n.scene_from_world.row(3), Eigen::RowVector4d(0, 0, 0, 1));
  EXPECT_LT((n.scene_from_world * n.scene_from_world.inverse() - Matrix4d::Identity()).norm(), 1e-9);
  EXPECT_NEAR(n.aabb_max.maxCoeff(), 1, 1e-12);
  EXPECT_LT(0, n.near);
  EXPECT_LT(n.near, n.far);
}

TEST(Normalise, AnInwardLookingCaptureIsCentredOnWhatItLooksAt) {
  const NormaliseInput input = Turntable();
  const Normalisation n = Normalise(input);
  ExpectSimilarity(n);
  EXPECT_TRUE(n.unbounded);
  EXPECT_LT(ToScene(n, kObject).norm(), 1e-6);
  std::vector<double> distances;
  for (const PosedCamera& camera : input.cameras) distances.push_back(ToScene(n, camera.center).norm());
  std::nth_element(distances.begin(), distances.begin() + 12, distances.end());
  EXPECT_NEAR(distances[12], 2, 0.1);
}

TEST(Normalise, UpIsZ) {
  for (const NormaliseInput& input : {Turntable(), SideBySide()}) {
    const Matrix3d rotation = AngleAxisd(1.1, Vector3d(1, 2, -1).normalized()).toRotationMatrix();
    const Normalisation n = Normalise(Transformed(input, 1, rotation, {0, 0, 0}));
    const Vector3d up = n.scene_from_world.topLeftCorner<3, 3>() * rotation * Vector3d::UnitZ() / n.scale;
    EXPECT_GT(up.z(), 1 - 1e-3);
  }
}

TEST(Normalise, CamerasThatLookDownDoNotTiltTheScene) {
  NormaliseInput input;
  for (int i = 0; i < 12; ++i) {
    const double angle = M_PI * i / 12;  // half a ring, 60° above
    input.cameras.push_back(LookAt({2 * std::cos(angle), 2 * std::sin(angle), 3.5}, {0, 0, 0}));
  }
  EXPECT_GT(UpDirection(input.cameras).z(), 0.99);
}

TEST(Normalise, IsTheSameSceneForEverySimilarityOfTheWorld) {
  NormaliseInput masked = Turntable();
  masked.masked = true;
  for (const NormaliseInput& input : {Turntable(), SideBySide(), masked}) {
    const Normalisation before = Normalise(input);
    for (const double scale : {1e-3, 1.0, 250.0}) {
      const Matrix3d rotation = AngleAxisd(2.2, Vector3d(-1, 0.4, 2).normalized()).toRotationMatrix();
      const Vector3d translation(10, -70, 3);
      const Normalisation after = Normalise(Transformed(input, scale, rotation, translation));
      ExpectSimilarity(after);
      EXPECT_NEAR(after.scale * scale, before.scale, 1e-6 * before.scale);
      EXPECT_NEAR(after.near, before.near, 1e-6);
      EXPECT_NEAR(after.far, before.far, 1e-6 * before.far);
      EXPECT_LT((after.aabb_max - before.aabb_max).norm(), 1e-6);
      for (const PosedCamera& camera : input.cameras) {
        const Vector3d moved = scale * (rotation * camera.center) + translation;
        EXPECT_LT((ToScene(after, moved) - ToScene(before, camera.center)).norm(), 1e-5);
      }
    }
  }
}

TEST(Normalise, AFewWrongCamerasAndPointsChangeLittle) {
  NormaliseInput input = Turntable();
  input.cameras[5] = LookAt({300, 200, -90}, {400, 0, 50});
  for (const Vector3d& point : Cloud(3, {1e5, -1e5, 1e5}, 10)) input.points.push_back(point);
  const Normalisation n = Normalise(input);
  EXPECT_LT(ToScene(n, kObject).norm(), 0.02);
  EXPECT_NEAR(n.scale, Normalise(Turntable()).scale, 0.05 * n.scale);
}

TEST(Normalise, AForwardLookingCaptureIsCentredOnItsPoints) {
  const Normalisation n = Normalise(SideBySide());
  ExpectSimilarity(n);
  EXPECT_TRUE(n.unbounded);
  EXPECT_LT(ToScene(n, {2, 10, 0}).norm(), 0.2);
  EXPECT_EQ(n.aabb_max, Vector3d::Ones());
}

TEST(Normalise, AGivenBoxIsKeptUnrotated) {
  NormaliseInput input = Turntable();
  input.box = {1, -3, 4.5, 5, -1, 5.5};
  const Normalisation n = Normalise(input);
  ExpectSimilarity(n);
  EXPECT_FALSE(n.unbounded);
  EXPECT_DOUBLE_EQ(n.scale, 0.5);
  EXPECT_LT((n.scene_from_world.topLeftCorner<3, 3>() - 0.5 * Matrix3d::Identity()).norm(), 1e-15);
  EXPECT_LT((ToScene(n, {1, -3, 4.5}) - n.aabb_min).norm(), 1e-12);
  EXPECT_LT((ToScene(n, {5, -1, 5.5}) - n.aabb_max).norm(), 1e-12);
}

TEST(Normalise, RaysReachABoundedBoxBetweenNearAndFar) {
  NormaliseInput input = Turntable();
  input.box = {2.2, -2.8, 4.2, 3.8, -1.2, 5.8};
  const Normalisation n = Normalise(input);
  for (const PosedCamera& camera : input.cameras) {
    for (int corner = 0; corner < 8; ++corner) {
      const Vector3d p((corner & 1 ? n.aabb_max : n.aabb_min).x(), (corner & 2 ? n.aabb_max : n.aabb_min).y(),
                       (corner & 4 ? n.aabb_max : n.aabb_min).z());
      const double distance = (p - ToScene(n, camera.center)).norm();
      EXPECT_LT(n.near, distance);
      EXPECT_GT(n.far, distance);
    }
  }
}

TEST(Normalise, MaskedAndPlainCapturesAreBoundedByTheirPoints) {
  NormaliseInput input = Turntable();
  input.points = Cloud(500, kObject, 0.8);
  EXPECT_TRUE(Normalise(input).unbounded);
  input.plain_background = true;
  EXPECT_FALSE(Normalise(input).unbounded);
  input.plain_background = false;
  input.masked = true;
  const Normalisation n = Normalise(input);
  EXPECT_FALSE(n.unbounded);
  for (const Vector3d& point : input.points) EXPECT_LT((ToScene(n, point).cwiseAbs() - n.aabb_max).maxCoeff(), 1e-9);
  EXPECT_TRUE(Normalise(input, true).unbounded);
  EXPECT_EQ(Normalise(input, true).contraction.reason, "forced by an option");
}

TEST(Normalise, AMaskedCaptureWithoutPointsIsBoundedByWhatAllCamerasSee) {
  NormaliseInput input = Turntable();
  input.points.clear();
  input.depths.clear();
  input.masked = true;
  const Normalisation n = Normalise(input);
  ExpectSimilarity(n);
  EXPECT_NEAR(1 / n.scale, std::sqrt(17.) * std::sin(0.4), 1e-6);
}

TEST(Normalise, DegenerateCapturesStillHaveAFiniteScene) {
  std::vector<NormaliseInput> inputs(5);
  inputs[0].cameras = {LookAt({1, 2, 3}, {1, 5, 3})};  // one camera
  inputs[1].cameras = {LookAt({1, 2, 3}, {1, 5, 3}), LookAt({1, 2, 3}, {4, 5, 3}),
                       LookAt({1, 2, 3}, {-4, 5, 2})};  // one place
  inputs[2].cameras = SideBySide().cameras;             // on a line, parallel
  inputs[3].cameras = {LookAt({0, 0, 0}, {0, 0, -1}, Vector3d::UnitY()),
                       LookAt({1, 0, 0}, {1, 0, -1}, Vector3d::UnitY())};  // down
  inputs[4].cameras = {LookAt({0, 0, 0}, {5, 5, 0}), LookAt({5, 0, 0}, {5, 5, 0}),
                       LookAt({10, 0, 0}, {5, 5, 0})};  // on a line, inwards
  for (size_t i = 0; i < inputs.size(); ++i) {
    SCOPED_TRACE(i);
    ExpectSimilarity(Normalise(inputs[i]));
    inputs[i].points = Cloud(100, {1, 9, 3}, 1);
    AddDepths(inputs[i]);
    ExpectSimilarity(Normalise(inputs[i]));
    inputs[i].points.assign(100, Vector3d(1, 9, 3));
    ExpectSimilarity(Normalise(inputs[i]));
  }
}

TEST(Normalise, SaysWhatIsNotFinite) {
  NormaliseInput input = Turntable();
  input.cameras[3].name = "IMG_3.jpg";
  input.cameras[3].center.x() = std::numeric_limits<double>::quiet_NaN();
  try {
    Normalise(input);
    FAIL();
  } catch (const Error& error) {
    EXPECT_EQ(error.code(), ExitCode::kInput);
    EXPECT_NE(std::string(error.what()).find("IMG_3.jpg"), std::string::npos);
  }
  input = Turntable();
  input.points[0].y() = std::numeric_limits<double>::infinity();
  EXPECT_THROW(Normalise(input), Error);
  input = Turntable();
  input.box = {0, 0, 0, 1, 0, 1};
  EXPECT_THROW(Normalise(input), Error);
  EXPECT_THROW(Normalise(NormaliseInput()), Error);
}

}  // namespace
}  // namespace nrff
