// Procedural patterns: hashes, noise and cells that never repeat, the same on every machine.
//
// Patterns are functions of a point and of its `footprint`: the width that one pixel covers there, in the same units.
// Detail finer than the footprint is faded to its mean, so that textures do not alias at any distance.
#pragma once

#include <Eigen/Core>
#include <cstdint>

namespace nrff {

using Vec2 = Eigen::Vector2d;
using Vec3d = Eigen::Vector3d;

// Mixes the bits of three numbers and a seed; uniform over 32 bits.
uint32_t Hash(int32_t x, int32_t y, int32_t z, uint32_t seed);

// `hash` as a number in [0, 1).
inline double UnitFromHash(uint32_t hash) { return hash * 0x1p-32; }

// 0 below `from`, 1 above `to`, a cubic between.
double SmoothStep(double from, double to, double x);

// Gradient noise [Perlin 2002]: mean 0, about [-1, 1], features of size 1.
double Noise(const Vec3d& p, uint32_t seed);

// Sum of octaves of `Noise`, each twice as fine and `gain` times as strong as the one before, the first of features of
// size `size`. Octaves below the footprint are left out.
double Fractal(const Vec3d& p, double size, int n_octaves, double gain, double footprint, uint32_t seed);

// The cell of a jittered-grid Voronoi diagram [Worley 1996] with cells of size 1.
struct Cell {
  uint32_t id;       // a hash: uniform over 32 bits
  double border;     // distance to the nearest border, 0 … about 0.5
  Vec2 from_centre;  // from the cell's point to `p`
};
Cell FindCell(const Vec2& p, uint32_t seed);

// Checks of size `size`, each with a random grey of mean 0 in [-1, 1]; fades to 0 where the footprint reaches `size`.
double RandomChecks(const Vec2& p, double size, double footprint, uint32_t seed);

}  // namespace nrff
