#include "sfm/distortion.h"

#include <Eigen/LU>
#include <cmath>
#include <string>

#include "pipeline/error.h"
#include "sfm/lens_model.h"

namespace nrff {
namespace {

using Eigen::Matrix2d;
using Eigen::Vector2d;
using lens_model::Distort;
using lens_model::Pair;

// u and v with their derivatives by (u, v).
using Dual = ceres::Jet<double, 2>;

Vector2d DistortedPoint(CameraModel model, const double* k, const Vector2d& uv) {
  const Pair<double> d = Distort(model, k, uv.x(), uv.y());
  return {d.u, d.v};
}

Matrix2d Jacobian(CameraModel model, const double* k, const Vector2d& uv, Vector2d* value) {
  const Pair<Dual> d = Distort(model, k, Dual(uv.x(), 0), Dual(uv.y(), 1));
  *value = {d.u.a, d.v.a};
  Matrix2d jacobian;
  jacobian << d.u.v.transpose(), d.v.v.transpose();
  return jacobian;
}

}  // namespace

Lens::Lens(const ColmapCamera& camera) : camera_(camera) {
  const std::string where =
      std::string("camera ") + std::to_string(camera.id) + " (" + CameraModelName(camera.model) + ")";
  if (int(camera.params.size()) != CameraModelParamCount(camera.model)) {
    throw InputError(where + " has " + std::to_string(camera.params.size()) + " parameters, expected " +
                     std::to_string(CameraModelParamCount(camera.model)) + "; export the model again");
  }
  for (const double param : camera.params) {
    if (!std::isfinite(param)) throw InputError(where + " has a parameter that is not finite; export the model again");
  }
  first_distortion_ = size_t(lens_model::FirstDistortion(camera.model));
  fx_ = camera.params[0];
  fy_ = camera.params[first_distortion_ - 3];  // the first again where there is one
  if (!(fx_ > 0) || !(fy_ > 0))
    throw InputError(where + " has a focal length that is not positive; export the model again");
  cx_ = camera.params[first_distortion_ - 2];
  cy_ = camera.params[first_distortion_ - 1];
  valid_radius_ = FindValidRadius();
}

std::optional<Vector2d> Lens::ImageFromCamera(const Vector2d& uv) const {
  if (!(uv.squaredNorm() < valid_radius_ * valid_radius_)) return {};
  const Vector2d d = DistortedPoint(camera_.model, camera_.params.data() + first_distortion_, uv);
  return Vector2d(d.x() * fx_ + cx_, d.y() * fy_ + cy_);
}

double Lens::FindValidRadius() const {
  if (camera_.model == CameraModel::kSimplePinhole || camera_.model == CameraModel::kPinhole) return kLargestRadius;
  const double* k = camera_.params.data() + first_distortion_;
  constexpr int kDirections = 64;
  double valid = kLargestRadius;
  for (int i = 0; i < kDirections; ++i) {
    const double angle = 2 * M_PI * i / kDirections;
    const Vector2d direction(std::cos(angle), std::sin(angle));
    Vector2d unused;
    const auto folded = [&](double r) {
      const double determinant = Jacobian(camera_.model, k, r * direction, &unused).determinant();
      return !(determinant > 0) || !std::isfinite(determinant);
    };
    double inside = 0;
    while (inside < valid) {  // `valid` shrinks from direction to direction: nothing beyond it is looked at again
      const double outside = inside + 0.005 * (1 + inside);
      if (!folded(outside)) {
        inside = outside;
        continue;
      }
      double low = inside, high = outside;
      for (int step = 0; step < 40; ++step) (folded((low + high) / 2) ? high : low) = (low + high) / 2;
      valid = std::min(valid, low);
      break;
    }
  }
  return valid;
}

std::optional<Vector2d> Lens::CameraFromImage(const Vector2d& px) const {
  const Vector2d target((px.x() - cx_) / fx_, (px.y() - cy_) / fy_);
  if (!target.allFinite()) return {};
  const double* k = camera_.params.data() + first_distortion_;
  // Along the ray's own direction, as if there were no tangential terms: distance from the centre grows up to the fold.
  const double distance = target.norm();
  if (distance == 0 && DistortedPoint(camera_.model, k, target).isZero(0)) return target;
  const Vector2d direction = distance > 0 ? Vector2d(target / distance) : Vector2d(1, 0);
  double low = 0, high = valid_radius_;
  for (int step = 0; step < 20; ++step) {
    const double middle = (low + high) / 2;
    (DistortedPoint(camera_.model, k, middle * direction).norm() < distance ? low : high) = middle;
  }
  Vector2d uv = (low + high) / 2 * direction, value;
  // Newton, each step shortened until it stays inside and comes closer.
  for (int iteration = 0; iteration < 50; ++iteration) {
    const Matrix2d jacobian = Jacobian(camera_.model, k, uv, &value);
    const Vector2d residual = value - target;
    if (residual.norm() <= 1e-15 * (1 + distance)) break;
    const Vector2d step = jacobian.inverse() * residual;
    if (!step.allFinite()) break;
    double fraction = 1;
    const auto better = [&](const Vector2d& candidate) {
      return candidate.norm() < valid_radius_ &&
             (DistortedPoint(camera_.model, k, candidate) - target).norm() < residual.norm();
    };
    while (fraction > 1e-6 && !better(uv - fraction * step)) fraction /= 2;
    if (fraction <= 1e-6) break;
    uv -= fraction * step;
  }
  const double error = (DistortedPoint(camera_.model, k, uv) - target).norm();
  if (!(error <= 1e-11 * (1 + distance)) || !(uv.norm() < valid_radius_)) return {};
  return uv;
}

}  // namespace nrff
