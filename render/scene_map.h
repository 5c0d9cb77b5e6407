// From scene space to field coordinates in [-1, 1]³.
//
// Bounded: affine, box → [-1, 1]³; nothing is outside. Sample intervals are in scene units.
// Unbounded: the foreground box → [-1, 1]³ affinely (u), then the contraction of mip-NeRF 360 [Barron22] in the L∞
// norm: c(u) = u for m = |u|∞ ≤ 1, (2 − 1/m)·u/m beyond, so that all space falls into [-2, 2]³; field coordinates are
// c/2. L∞ keeps the foreground box a box of the grids. Sample intervals are in contracted units (the step in u is
// step·max(1, m²)), so that far samples get thinner and σ keeps its range.
#pragma once

#include <array>
#include <cmath>

namespace nrff {

struct SceneMap {
  bool unbounded = false;
  std::array<float, 3> center{0, 0, 0};       // of the box, scene units
  std::array<float, 3> half_extent{1, 1, 1};  // of the box, scene units

  // scene point → field coordinates
  template <typename Scalar>
  void ToField(const Scalar scene[3], Scalar field[3]) const {
    Scalar u[3], m = 0;
    for (int i = 0; i < 3; ++i) {
      u[i] = (scene[i] - Scalar(center[i])) / Scalar(half_extent[i]);
      m = std::max(m, std::abs(u[i]));
    }
    if (!unbounded) {
      for (int i = 0; i < 3; ++i) field[i] = u[i];
      return;
    }
    const Scalar scale = m <= 1 ? Scalar(0.5) : Scalar(0.5) * (2 - 1 / m) / m;
    for (int i = 0; i < 3; ++i) field[i] = scale * u[i];
  }
};

}  // namespace nrff
