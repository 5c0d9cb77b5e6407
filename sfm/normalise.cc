#include "sfm/normalise.h"

#include <Eigen/Eigenvalues>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "pipeline/error.h"

namespace nrff {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

constexpr double kCameraDistance = 2;   // of the median camera from the centre, in half-extents of the foreground box
constexpr double kFarUnbounded = 1000;  // scene units: the contraction leaves 0.1 % of its shell beyond
constexpr double kNearDefault = 0.1;    // scene units, where nothing is known
constexpr double kMargin = 1.1;         // of boxes around points
constexpr size_t kFewestPoints = 32;    // that quantiles are taken of
constexpr double kParallel = 0.01;  // smallest eigenvalue of the mean of I − d dᵀ that fixes a focus point: sin² 6°

double Quantile(std::vector<double> values, double q) {
  const auto nth = values.begin() + std::lround(q * double(values.size() - 1));
  std::nth_element(values.begin(), nth, values.end());
  return *nth;
}

Vector3d ViewDirection(const PosedCamera& camera) { return camera.world_from_camera.col(2); }

Vector3d MeanCenter(const std::vector<PosedCamera>& cameras) {
  Vector3d sum = Vector3d::Zero();
  for (const PosedCamera& camera : cameras) sum += camera.center;
  return sum / double(cameras.size());
}

void CheckInput(const NormaliseInput& input) {
  if (input.cameras.empty()) throw InputError("no camera has a pose: nothing can be normalised");
  for (const PosedCamera& camera : input.cameras) {
    if (!camera.center.allFinite() || !camera.world_from_camera.allFinite()) {
      throw InputError("the pose of " + camera.name +
                       " is not finite; estimate the poses again or leave the photo out");
    }
  }
  for (const Vector3d& point : input.points) {
    if (!point.allFinite()) throw InputError("a sparse point is not finite; estimate the poses again");
  }
  if (!input.box) return;
  const auto& b = *input.box;
  for (int i = 0; i < 3; ++i) {
    if (!std::isfinite(b[i]) || !std::isfinite(b[i + 3]) || !(b[i] < b[i + 3])) {
      throw InputError("the capture's bounding box runs from " + std::to_string(b[i]) + " to " +
                       std::to_string(b[i + 3]) + " along " + "xyz"[i] + "; expected a minimum below a maximum");
    }
  }
}

// Columns: the scene's axes in the world. x completes; y is the horizontal direction the cameras look in on average or,
// where they look all round, the first camera's.
Matrix3d SceneAxes(const std::vector<PosedCamera>& cameras) {
  const Vector3d up = UpDirection(cameras);
  const auto horizontal = [&](const Vector3d& v) { return Vector3d(v - v.dot(up) * up); };
  Vector3d mean = Vector3d::Zero();
  for (const PosedCamera& camera : cameras) mean += ViewDirection(camera) / double(cameras.size());
  Vector3d forward = horizontal(mean);
  if (forward.norm() < 0.3) forward = horizontal(ViewDirection(cameras[0]));
  if (forward.norm() < 1e-3) forward = horizontal(-cameras[0].world_from_camera.col(1));  // it looks straight down
  if (forward.norm() < 1e-3) forward = horizontal(cameras[0].world_from_camera.col(0));
  forward.normalize();
  Matrix3d axes;
  axes << forward.cross(up), forward, up;
  return axes;
}

struct Box {
  Vector3d center, half_extent;
};

// The points' quantiles along the axes, with a margin.
Box RobustBox(const std::vector<Vector3d>& points, const Matrix3d& axes, double outside) {
  Vector3d low, high;
  for (int i = 0; i < 3; ++i) {
    std::vector<double> along;
    along.reserve(points.size());
    for (const Vector3d& point : points) along.push_back(axes.col(i).dot(point));
    low[i] = Quantile(along, outside);
    high[i] = Quantile(along, 1 - outside);
  }
  return {axes * ((low + high) / 2), (high - low) / 2 * kMargin};
}

// Quantile over the cameras of what `measure` says of each.
template <typename Measure>
double CameraQuantile(const std::vector<PosedCamera>& cameras, double q, const Measure& measure) {
  std::vector<double> values;
  values.reserve(cameras.size());
  for (const PosedCamera& camera : cameras) values.push_back(measure(camera));
  return Quantile(std::move(values), q);
}

// Radius of the ball around `center` that every camera sees whole (nearly: one in twenty may see less).
double SeenRadius(const std::vector<PosedCamera>& cameras, const Vector3d& center) {
  return CameraQuantile(cameras, 0.05, [&](const PosedCamera& camera) {
    return (camera.center - center).norm() * std::sin(camera.half_field);
  });
}

double MedianDistance(const std::vector<PosedCamera>& cameras, const Vector3d& center) {
  return CameraQuantile(cameras, 0.5, [&](const PosedCamera& camera) { return (camera.center - center).norm(); });
}

// Median distance of the cameras from their mean; exactly 0 where they differ by no more than rounding.
double Baseline(const std::vector<PosedCamera>& cameras) {
  double magnitude = 0;
  for (const PosedCamera& camera : cameras) magnitude = std::max(magnitude, camera.center.norm());
  const double baseline = MedianDistance(cameras, MeanCenter(cameras));
  return baseline > 1e-9 * magnitude ? baseline : 0;
}

// Share of the points outside the ball that the cameras see whole, enlarged to its cube's corners.
std::optional<double> BackgroundFraction(const std::vector<Vector3d>& points, const Vector3d& center,
                                         double seen_radius) {
  if (points.size() < kFewestPoints) return {};
  const auto outside = [&](const Vector3d& p) { return (p - center).norm() > std::sqrt(3.0) * seen_radius; };
  return double(std::count_if(points.begin(), points.end(), outside)) / double(points.size());
}

Matrix3d RotationOf(const Normalisation& n) { return n.scene_from_world.topLeftCorner<3, 3>() / n.scale; }

// Makes `box` (along `axes`) the unit box: largest half-extent 1, centre at the origin.
void SetBox(const Box& box, const Matrix3d& axes, Normalisation& n) {
  const double largest = box.half_extent.maxCoeff();
  n.scale = 1 / largest;
  n.scene_from_world.topLeftCorner<3, 3>() = n.scale * axes.transpose();
  n.scene_from_world.topRightCorner<3, 1>() = -n.scale * (axes.transpose() * box.center);
  n.aabb_max = box.half_extent / largest;
  n.aabb_min = -n.aabb_max;
}

// Where rays enter and leave the box, over all cameras.
void SetBoundedRange(const std::vector<PosedCamera>& cameras, Normalisation& n) {
  const Matrix3d rotation = RotationOf(n);
  double near = std::numeric_limits<double>::infinity(), far = 0;
  for (const PosedCamera& camera : cameras) {
    const Vector3d position = n.scale * (rotation * camera.center) + n.scene_from_world.topRightCorner<3, 1>();
    const Vector3d outside = (position.cwiseAbs() - n.aabb_max).cwiseMax(0);
    near = std::min(near, outside.norm());
    far = std::max(far, (position.cwiseAbs() + n.aabb_max).norm());
  }
  n.near = std::max(0.95 * near, 0.01);
  n.far = std::max(1.01 * far, 2 * n.near);
}

void SetUnboundedRange(const std::vector<double>& depths, Normalisation& n) {
  n.far = kFarUnbounded;
  n.near = kNearDefault;
  if (depths.size() < kFewestPoints) return;
  n.near = std::clamp(0.5 * n.scale * Quantile(depths, 0.001), 0.01, 1.0);
  n.far = std::max(kFarUnbounded, 4 * n.scale * Quantile(depths, 0.999));
}

// Cube of the foreground where the cameras do not look inwards.
Box ForwardBox(const NormaliseInput& input, const Matrix3d& axes) {
  if (input.points.size() >= kFewestPoints) {
    const Box box = RobustBox(input.points, axes, 0.05);
    if (box.half_extent.maxCoeff() > 0) return {box.center, Vector3d::Constant(box.half_extent.maxCoeff())};
  }
  // No points to go by: ahead of the cameras, at a distance that their baseline suggests.
  const Vector3d center = MeanCenter(input.cameras);
  Vector3d forward = Vector3d::Zero();
  for (const PosedCamera& camera : input.cameras) forward += ViewDirection(camera);
  if (forward.norm() > 0) forward.normalize();
  const double baseline = Baseline(input.cameras);
  const double distance = baseline > 0 ? 10 * baseline : 1;
  return {center + distance * forward, Vector3d::Constant(distance / kCameraDistance)};
}

}  // namespace

Vector3d UpDirection(const std::vector<PosedCamera>& cameras) {
  Matrix3d x_axes = Matrix3d::Zero();
  Vector3d photo_up = Vector3d::Zero();
  for (const PosedCamera& camera : cameras) {
    const Vector3d x = camera.world_from_camera.col(0);
    x_axes += x * x.transpose() / double(cameras.size());
    photo_up -= camera.world_from_camera.col(1) / double(cameras.size());
  }
  if (photo_up.norm() > 0.05) {
    // Decides where the x axes leave a plane open, as they do when all cameras stand side by side.
    const Vector3d mean = photo_up.normalized();
    x_axes += 0.02 * (Matrix3d::Identity() - mean * mean.transpose());
  }
  const Eigen::SelfAdjointEigenSolver<Matrix3d> solver(x_axes);  // ascending
  const Vector3d up = solver.eigenvectors().col(0);
  const double side = up.dot(photo_up);
  return side < 0 ? Vector3d(-up) : up;
}

std::optional<Vector3d> FocusPoint(const std::vector<PosedCamera>& cameras) {
  if (cameras.size() < 2) return {};
  std::vector<double> weights(cameras.size(), 1);
  Vector3d focus = Vector3d::Zero();
  const double extent = Baseline(cameras);
  if (!(extent > 0)) return {};
  for (int iteration = 0; iteration < 30; ++iteration) {
    Matrix3d normal = Matrix3d::Zero();
    Vector3d right = Vector3d::Zero();
    double total = 0;
    for (size_t i = 0; i < cameras.size(); ++i) {
      const Vector3d d = ViewDirection(cameras[i]);
      const Matrix3d across = weights[i] * (Matrix3d::Identity() - d * d.transpose());
      normal += across;
      right += across * cameras[i].center;
      total += weights[i];
    }
    const Eigen::SelfAdjointEigenSolver<Matrix3d> solver(normal / total, Eigen::EigenvaluesOnly);
    if (solver.eigenvalues()[0] < kParallel) return {};
    focus = normal.inverse() * right;
    for (size_t i = 0; i < cameras.size(); ++i) {
      const Vector3d offset = focus - cameras[i].center;
      const double distance = offset.cross(ViewDirection(cameras[i])).norm();
      weights[i] = extent / std::max(distance, 1e-3 * extent);
    }
  }
  size_t in_front = 0;
  for (const PosedCamera& camera : cameras) in_front += (focus - camera.center).dot(ViewDirection(camera)) > 0;
  if (in_front < cameras.size() * 4 / 5) return {};
  return focus;
}

Normalisation Normalise(const NormaliseInput& input, std::optional<bool> force_contraction) {
  CheckInput(input);
  Normalisation n;
  const std::optional<Vector3d> focus = FocusPoint(input.cameras);
  const double seen_radius = focus ? SeenRadius(input.cameras, *focus) : 0;
  const std::optional<double> background_fraction =
      focus && input.plain_background ? BackgroundFraction(input.points, *focus, seen_radius) : std::nullopt;
  n.contraction = needs::Contraction(input.box.has_value(), input.masked, background_fraction);
  Force(n.contraction, force_contraction);
  n.unbounded = n.contraction.needed;

  const Matrix3d axes = SceneAxes(input.cameras);
  if (input.box) {
    const Vector3d low(input.box->data()), high(input.box->data() + 3);
    SetBox({(low + high) / 2, (high - low) / 2}, Matrix3d::Identity(), n);
  } else if (focus && n.unbounded) {
    SetBox({*focus, Vector3d::Constant(MedianDistance(input.cameras, *focus) / kCameraDistance)}, axes, n);
  } else if (focus && input.points.size() >= kFewestPoints) {
    Box box = RobustBox(input.points, axes, 0.005);
    box.half_extent = box.half_extent.cwiseMax(0.05 * box.half_extent.maxCoeff());  // a plane still needs a volume
    if (!(box.half_extent.maxCoeff() > 0)) box = {*focus, Vector3d::Constant(seen_radius)};
    SetBox(box, axes, n);
  } else if (focus) {
    SetBox({*focus, Vector3d::Constant(seen_radius)}, axes, n);
  } else {
    SetBox(ForwardBox(input, axes), axes, n);
  }
  if (!std::isfinite(n.scale) || !(n.scale > 0)) {
    throw InputError("the cameras and points give no finite scale to the scene; estimate the poses again");
  }
  if (n.unbounded) {
    SetUnboundedRange(input.depths, n);
  } else {
    SetBoundedRange(input.cameras, n);
  }
  return n;
}

}  // namespace nrff
