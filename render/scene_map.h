// From scene space to field coordinates in [-1, 1]³, and back.
//
// Bounded: affine, box → [-1, 1]³; nothing is outside. Sample intervals are in scene units.
// Unbounded: the foreground box → [-1, 1]³ affinely (u), then the contraction of mip-NeRF 360 [Barron22] in the L∞
// norm: c(u) = u for m = |u|∞ ≤ 1, (2 − 1/m)·u/m beyond, so that all space falls into [-2, 2]³; field coordinates are
// c/2. L∞ keeps the foreground box a box of the grids. Sample intervals are in contracted units (the step in u is
// step·max(1, m²)), so that far samples get thinner and σ keeps its range.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "render/kernels/device.h"

namespace nrff {

struct SceneMap {
  bool unbounded = false;
  std::array<double, 3> center{0, 0, 0};       // of the box, scene units
  std::array<double, 3> half_extent{1, 1, 1};  // of the box, scene units

  static SceneMap FromBox(const std::array<double, 3>& min, const std::array<double, 3>& max, bool unbounded) {
    SceneMap map;
    map.unbounded = unbounded;
    for (int k = 0; k < 3; ++k) {
      map.center[k] = 0.5 * (min[k] + max[k]);
      map.half_extent[k] = 0.5 * (max[k] - min[k]);
    }
    return map;
  }

  // scene point → field coordinates
  template <typename Scalar>
  void ToField(const Scalar scene[3], Scalar field[3]) const {
    Scalar u[3], m = 0;
    for (int k = 0; k < 3; ++k) {
      u[k] = (scene[k] - Scalar(center[k])) / Scalar(half_extent[k]);
      if (unbounded) u[k] = std::clamp(u[k], -kFarthest<Scalar>, kFarthest<Scalar>);  // infinity · 0 is no number
      m = std::max(m, std::abs(u[k]));
    }
    const Scalar scale = unbounded ? ContractionScale(m) : Scalar(1);
    for (int k = 0; k < 3; ++k) field[k] = scale * u[k];
  }

  // field coordinates → scene point. Unbounded: |field|∞ < 1 (the faces of the cube lie at infinity).
  template <typename Scalar>
  void ToScene(const Scalar field[3], Scalar scene[3]) const {
    const Scalar m = 2 * std::max({std::abs(field[0]), std::abs(field[1]), std::abs(field[2])});
    // m_u = 1/(2 − m), u = c·m_u/m
    const Scalar scale = !unbounded ? Scalar(1) : m <= 1 ? Scalar(2) : 2 / ((2 - m) * m);
    for (int k = 0; k < 3; ++k) scene[k] = Scalar(center[k]) + Scalar(half_extent[k]) * scale * field[k];
  }

  // Distance along the ray between neighbouring samples at `scene` for a marching step of `step` (kernels/sampling.h).
  NRFF_HOST_DEVICE double StepAt(const double scene[3], const double direction[3], double step) const {
    if (!unbounded) return step;
    double m = 1, squared_speed = 0;
    for (int k = 0; k < 3; ++k) {
      m = std::max(m, std::abs((scene[k] - center[k]) / half_extent[k]));
      squared_speed += direction[k] * direction[k] / (half_extent[k] * half_extent[k]);
    }
    return step * m * m / std::sqrt(squared_speed);
  }

  // Beyond it the contraction's own terms leave the range of normal numbers; field coordinates are ±1 long before.
  template <typename Scalar>
  static constexpr Scalar kFarthest = Scalar(1) / (4 * std::numeric_limits<Scalar>::min());

  // Field coordinates = ContractionScale(|u|∞)·u in unbounded scenes.
  template <typename Scalar>
  NRFF_HOST_DEVICE static Scalar ContractionScale(Scalar m) {
    return m <= 1 ? Scalar(0.5) : Scalar(0.5) * (2 - 1 / m) / m;
  }
};

}  // namespace nrff
