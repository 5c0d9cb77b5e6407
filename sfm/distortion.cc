#include "sfm/distortion.h"

#include <Eigen/LU>
#include <cmath>
#include <string>
#include <unsupported/Eigen/AutoDiff>

#include "pipeline/error.h"

namespace nrff {
namespace {

using Eigen::Matrix2d;
using Eigen::Vector2d;
using std::sqrt;

// u and v with their derivatives by (u, v).
using Dual = Eigen::AutoDiffScalar<Vector2d>;

double Value(double x) { return x; }
double Value(const Dual& x) { return x.value(); }

double ArcTangent(double x) { return std::atan(x); }
Dual ArcTangent(const Dual& x) { return {std::atan(x.value()), x.derivatives() / (1 + x.value() * x.value())}; }

// θ/r, where θ = atan(r): the ratio by which a fisheye's equidistant image is smaller than a pinhole's.
template <typename T>
T AngleOverRadius(const T& r2) {
  if (Value(r2) < 1e-8) return T(1.0 - r2 / 3.0);  // next term r⁴/5 ≤ 2e-17
  const T r = sqrt(r2);
  return T(ArcTangent(r) / r);
}

template <typename T>
struct Pair {
  T u, v;
};

// Tangential terms of Brown's model.
template <typename T>
Pair<T> Tangential(const T& u, const T& v, double p1, double p2) {
  const T r2 = u * u + v * v;
  return {2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u), 2.0 * p2 * u * v + p1 * (r2 + 2.0 * v * v)};
}

// 1 + k[0] x + k[1] x² + …
template <typename T>
T Polynomial(const T& x, const double* k, int n) {
  T sum(0.0);
  for (int i = n - 1; i >= 0; --i) sum = x * (sum + k[i]);
  return T(1.0 + sum);
}

// Camera coordinates → distorted camera coordinates.
template <typename T>
Pair<T> Distort(CameraModel model, const double* k, const T& u, const T& v) {
  const T r2 = u * u + v * v;
  const auto scaled = [&](const T& factor) { return Pair<T>{u * factor, v * factor}; };
  const auto fisheye = [&](int n) {
    const T ratio = AngleOverRadius(r2);
    const T theta2 = ratio * ratio * r2;
    return scaled(ratio * Polynomial(theta2, k, n));
  };
  switch (model) {
    case CameraModel::kSimplePinhole:
    case CameraModel::kPinhole:
      return {u, v};
    case CameraModel::kSimpleRadial:
      return scaled(Polynomial(r2, k, 1));
    case CameraModel::kRadial:
      return scaled(Polynomial(r2, k, 2));
    case CameraModel::kOpenCV: {
      const T radial = Polynomial(r2, k, 2);
      const Pair<T> tangential = Tangential(u, v, k[2], k[3]);
      return {u * radial + tangential.u, v * radial + tangential.v};
    }
    case CameraModel::kOpenCVFisheye:
      return fisheye(4);
    case CameraModel::kFullOpenCV: {
      const T radial = (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / Polynomial(r2, k + 5, 3);
      const Pair<T> tangential = Tangential(u, v, k[2], k[3]);
      return {u * radial + tangential.u, v * radial + tangential.v};
    }
    case CameraModel::kFov: {
      const double omega = k[0];
      if (std::abs(omega) < 1e-6) return {u, v};
      const double tangent = 2 * std::tan(omega / 2);
      return scaled(AngleOverRadius<T>(r2 * (tangent * tangent)) * (tangent / omega));
    }
    case CameraModel::kSimpleRadialFisheye:
      return fisheye(1);
    case CameraModel::kRadialFisheye:
      return fisheye(2);
    case CameraModel::kThinPrismFisheye: {
      const T ratio = AngleOverRadius(r2);
      const T a = u * ratio, b = v * ratio;
      const T s2 = a * a + b * b;
      const T radial = 1.0 + s2 * (k[0] + s2 * (k[1] + s2 * (k[4] + s2 * k[5])));
      const Pair<T> tangential = Tangential(a, b, k[2], k[3]);
      return {a * radial + tangential.u + k[6] * s2, b * radial + tangential.v + k[7] * s2};
    }
  }
  return {u, v};
}

Vector2d DistortedPoint(CameraModel model, const double* k, const Vector2d& uv) {
  const Pair<double> d = Distort(model, k, uv.x(), uv.y());
  return {d.u, d.v};
}

Matrix2d Jacobian(CameraModel model, const double* k, const Vector2d& uv, Vector2d* value) {
  const Pair<Dual> d = Distort(model, k, Dual(uv.x(), 2, 0), Dual(uv.y(), 2, 1));
  *value = {d.u.value(), d.v.value()};
  Matrix2d jacobian;
  jacobian << d.u.derivatives().transpose(), d.v.derivatives().transpose();
  return jacobian;
}

bool HasOneFocalLength(CameraModel model) {
  return model == CameraModel::kSimplePinhole || model == CameraModel::kSimpleRadial || model == CameraModel::kRadial ||
         model == CameraModel::kSimpleRadialFisheye || model == CameraModel::kRadialFisheye;
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
  const bool one_focal = HasOneFocalLength(camera.model);
  fx_ = camera.params[0];
  fy_ = camera.params[one_focal ? 0 : 1];
  if (!(fx_ > 0) || !(fy_ > 0))
    throw InputError(where + " has a focal length that is not positive; export the model again");
  first_distortion_ = one_focal ? 3 : 4;
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
