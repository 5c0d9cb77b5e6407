#include "examples/procedural.h"

#include <algorithm>
#include <cmath>

namespace nrff {

uint32_t Hash(int32_t x, int32_t y, int32_t z, uint32_t seed) {
  uint32_t h = seed * 0x9E3779B9u;
  for (const int32_t value : {x, y, z}) {
    h = (h ^ static_cast<uint32_t>(value)) * 0x85EBCA6Bu;
    h ^= h >> 15;
  }
  h *= 0xC2B2AE35u;
  h ^= h >> 16;
  h *= 0x27D4EB2Fu;
  return h ^ (h >> 15);
}

double SmoothStep(double from, double to, double x) {
  const double t = std::clamp((x - from) / (to - from), 0.0, 1.0);
  return t * t * (3 - 2 * t);
}

namespace {

uint32_t Mix(int32_t value, uint32_t seed) {
  uint32_t h = (static_cast<uint32_t>(value) ^ seed * 0x9E3779B9u) * 0x85EBCA6Bu;
  h = (h ^ (h >> 15)) * 0xC2B2AE35u;
  return h ^ (h >> 16);
}

// Dot product of (dx, dy, dz) with one of sixteen gradients: the edge directions of a cube, four of them twice.
double GradientDot(uint32_t hash, double dx, double dy, double dz) {
  static constexpr double kGradients[16][3] = {
      {1, 1, 0}, {-1, 1, 0}, {1, -1, 0}, {-1, -1, 0}, {1, 0, 1}, {-1, 0, 1}, {1, 0, -1}, {-1, 0, -1},
      {0, 1, 1}, {0, -1, 1}, {0, 1, -1}, {0, -1, -1}, {1, 1, 0}, {-1, 1, 0}, {0, -1, 1}, {0, -1, -1}};
  const double* gradient = kGradients[(hash * 0x27D4EB2Fu) >> 28];
  return gradient[0] * dx + gradient[1] * dy + gradient[2] * dz;
}

// As std::floor, which is a call into the mathematics library on processors of the baseline.
int32_t Floor(double x) {
  const int32_t truncated = static_cast<int32_t>(x);
  return truncated - (x < truncated);
}

double Fade(double t) { return t * t * t * (t * (t * 6 - 15) + 10); }

// Weight of detail of size `size` under a footprint: 1 when well resolved, 0 when a pixel covers half a period.
double Resolved(double size, double footprint) { return 1 - SmoothStep(0.25, 0.5, footprint / size); }

}  // namespace

double Noise(const Vec3d& p, uint32_t seed) {
  const int32_t x = Floor(p.x()), y = Floor(p.y()), z = Floor(p.z());
  const double dx = p.x() - x, dy = p.y() - y, dz = p.z() - z;
  // The eight corners' hashes are put together from the coordinates' own.
  const uint32_t hash_x[2] = {Mix(x, seed), Mix(x + 1, seed)};
  const uint32_t hash_y[2] = {Mix(y, seed + 0x632BE59Bu), Mix(y + 1, seed + 0x632BE59Bu)};
  const uint32_t hash_z[2] = {Mix(z, seed + 0x7F4A7C15u), Mix(z + 1, seed + 0x7F4A7C15u)};
  const double u = Fade(dx), v = Fade(dy), w = Fade(dz);
  double along_z[2] = {};
  const int n_planes = dz > 0 ? 2 : 1;  // patterns in the plane z = 0 need one
  for (int k = 0; k < n_planes; ++k) {
    double along_y[2];
    for (int j = 0; j < 2; ++j) {
      const uint32_t hash_yz = hash_y[j] + hash_z[k];
      const double left = GradientDot(hash_x[0] + hash_yz, dx, dy - j, dz - k);
      const double right = GradientDot(hash_x[1] + hash_yz, dx - 1, dy - j, dz - k);
      along_y[j] = left + u * (right - left);
    }
    along_z[k] = along_y[0] + v * (along_y[1] - along_y[0]);
  }
  return along_z[0] + w * (along_z[1] - along_z[0]);
}

double Fractal(const Vec3d& p, double size, int n_octaves, double gain, double footprint, uint32_t seed) {
  double sum = 0, amplitude = 1;
  for (int octave = 0; octave < n_octaves; ++octave) {
    const double resolved = Resolved(size, footprint);
    if (resolved <= 0) break;
    sum += resolved * amplitude * Noise(p / size, seed + static_cast<uint32_t>(octave));
    size *= 0.5;
    amplitude *= gain;
  }
  return sum;
}

Cell FindCell(const Vec2& p, uint32_t seed) {
  const int32_t column = Floor(p.x()), row = Floor(p.y());
  Cell cell{};
  Vec2 points[9];
  int nearest = 0;
  double nearest_distance = 1e30;
  for (int i = 0; i < 9; ++i) {
    const int32_t x = column + i % 3 - 1, y = row + i / 3 - 1;
    const uint32_t id = Hash(x, y, 0, seed);
    // A jitter of 0.8 keeps the nearest point within the 3 × 3 neighbours.
    points[i] = Vec2(x + 0.1 + 0.8 * (id & 0xFFFF) / 65536.0, y + 0.1 + 0.8 * (id >> 16) / 65536.0);
    const double distance = (p - points[i]).squaredNorm();
    if (distance < nearest_distance) {
      nearest_distance = distance;
      nearest = i;
      cell.id = Hash(static_cast<int32_t>(id), x, y, seed + 1);
    }
  }
  cell.from_centre = p - points[nearest];
  cell.border = 1e30;
  for (int i = 0; i < 9; ++i) {
    if (i == nearest) continue;
    const Vec2 between = points[i] - points[nearest];
    cell.border = std::min(cell.border, (between * 0.5 - cell.from_centre).dot(between.normalized()));
  }
  return cell;
}

double RandomChecks(const Vec2& p, double size, double footprint, uint32_t seed) {
  const double resolved = Resolved(size, footprint);
  if (resolved <= 0) return 0;
  const uint32_t hash = Hash(Floor(p.x() / size), Floor(p.y() / size), 0, seed);
  return resolved * (2 * UnitFromHash(hash) - 1);
}

}  // namespace nrff
