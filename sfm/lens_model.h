// The closed forms of COLMAP's camera models, for values and for derivatives by rays and parameters alike.
//
// `T` is the number of a ray's coordinates and `K` that of the lens's parameters: double, or ceres::Jet where
// derivatives by them are wanted.
#pragma once

#include <ceres/jet.h>

#include <cmath>

#include "sfm/colmap_model.h"

namespace nrff::lens_model {

inline bool HasOneFocalLength(CameraModel model) {
  return model == CameraModel::kSimplePinhole || model == CameraModel::kSimpleRadial || model == CameraModel::kRadial ||
         model == CameraModel::kSimpleRadialFisheye || model == CameraModel::kRadialFisheye;
}

// Parameters are one or two focal lengths, the principal point, then distortion from this index on.
inline int FirstDistortion(CameraModel model) { return HasOneFocalLength(model) ? 3 : 4; }

inline double Value(double x) { return x; }
template <int N>
double Value(const ceres::Jet<double, N>& x) {
  return x.a;
}

// θ/r, where θ = atan(r): the ratio by which a fisheye's equidistant image is smaller than a pinhole's.
template <typename T>
T AngleOverRadius(const T& r2) {
  using std::atan;
  using std::sqrt;
  if (Value(r2) < 1e-8) return 1.0 - r2 / 3.0;  // next term r⁴/5 ≤ 2e-17
  const T r = sqrt(r2);
  return atan(r) / r;
}

template <typename T>
struct Pair {
  T u, v;
};

// Tangential terms of Brown's model.
template <typename T, typename K>
Pair<T> Tangential(const T& u, const T& v, const K& p1, const K& p2) {
  const T r2 = u * u + v * v;
  return {2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u), 2.0 * p2 * u * v + p1 * (r2 + 2.0 * v * v)};
}

// 1 + k[0] x + k[1] x² + …
template <typename T, typename K>
T Polynomial(const T& x, const K* k, int n) {
  T sum(0.0);
  for (int i = n - 1; i >= 0; --i) sum = x * (sum + k[i]);
  return 1.0 + sum;
}

// Camera coordinates → distorted camera coordinates; `k`: the parameters from FirstDistortion on.
template <typename T, typename K>
Pair<T> Distort(CameraModel model, const K* k, const T& u, const T& v) {
  using std::tan;
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
      const K omega = k[0];
      if (std::abs(Value(omega)) < 1e-6) return {u, v};
      const K tangent = 2.0 * tan(omega / 2.0);
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

}  // namespace nrff::lens_model
