#include "render/occupancy_grid.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <string>
#include <utility>

#include "pipeline/error.h"
#include "render/kernels/random.h"
#include "render/radiance_field.h"

namespace nrff {
namespace {

constexpr int64_t kCellsPerBlock = int64_t{kOccupancyBlock} * kOccupancyBlock * kOccupancyBlock;
constexpr float kNeverMeasured = -1;

int64_t CountBits(const std::vector<uint64_t>& words) {
  int64_t n = 0;
  for (const uint64_t word : words) n += std::popcount(word);
  return n;
}

// Appends `n_draws` set bits of `words`, one from each of as many equal strata of their order, so without repetition
// and in memory order; all of them when there are no more. `draw(k)` is uniform in [0, 1).
template <typename Draw>
void DrawBits(const std::vector<uint64_t>& words, int64_t n_draws, Draw&& draw, std::vector<int64_t>& drawn) {
  const int64_t n_bits = CountBits(words);
  n_draws = std::min(n_draws, n_bits);
  const double stratum = static_cast<double>(n_bits) / static_cast<double>(std::max<int64_t>(n_draws, 1));
  size_t word = 0;
  int64_t bits_before = 0, bits_here = std::popcount(words[0]);
  for (int64_t k = 0; k < n_draws; ++k) {
    const auto rank = std::min(static_cast<int64_t>((static_cast<double>(k) + draw(k)) * stratum), n_bits - 1);
    while (bits_before + bits_here <= rank) {
      bits_before += bits_here;
      bits_here = std::popcount(words[++word]);
    }
    uint64_t rest = words[word];
    for (int64_t skip = rank - bits_before; skip > 0; --skip) rest &= rest - 1;
    drawn.push_back(static_cast<int64_t>(word) * 64 + std::countr_zero(rest));
  }
}

using Corners = std::array<Vec3, 8>;

// The scene images of the corners of the cube of half side `half` at `center`, both in field coordinates. The faces of
// the contracted space, which lie at infinity, are taken a little inside.
Corners SceneCorners(const SceneMap& map, const double center[3], double half) {
  const double limit = map.unbounded ? 1 - 1e-4 : 1;
  Corners corners;
  for (int c = 0; c < 8; ++c) {
    double field[3];
    for (int k = 0; k < 3; ++k) {
      field[k] = std::clamp(center[k] + ((c >> k & 1) != 0 ? half : -half), -limit, limit);
    }
    map.ToScene(field, corners[c].data());
  }
  return corners;
}

enum class Overlap { kNone, kPartial, kWhole };

// A view as four side planes and the near plane, in scene space.
class Frustum {
 public:
  Frustum(const View& view, double near) : near_(near) {
    const Mat4& m = view.scene_from_camera;
    origin_ = {m[3], m[7], m[11]};
    normals_[0] = Rotate(m, {view.fx, 0, view.cx});                 // x ≥ 0 px
    normals_[1] = Rotate(m, {-view.fx, 0, view.width - view.cx});   // x ≤ width
    normals_[2] = Rotate(m, {0, view.fy, view.cy});                 // y ≥ 0 px
    normals_[3] = Rotate(m, {0, -view.fy, view.height - view.cy});  // y ≤ height
    normals_[4] = Rotate(m, {0, 0, 1});                             // z ≥ near
  }

  // Of the frustum with the convex hull of the corners, which holds the image of their cube but for the curvature that
  // the contraction gives to its sides: the slack. A hull that no single plane separates counts as seen.
  Overlap With(const Corners& corners) const {
    const Vec3& first = corners.front();
    const Vec3& last = corners.back();
    const double slack = 0.02 * std::hypot(last[0] - first[0], last[1] - first[1], last[2] - first[2]);
    Overlap overlap = Overlap::kWhole;
    for (int plane = 0; plane < 5; ++plane) {
      const double offset = Dot(normals_[plane], origin_) + (plane == 4 ? near_ : 0);
      double low = Dot(normals_[plane], first) - offset, high = low;
      for (int c = 1; c < 8; ++c) {
        const double distance = Dot(normals_[plane], corners[c]) - offset;
        low = std::min(low, distance);
        high = std::max(high, distance);
      }
      if (high < -slack) return Overlap::kNone;
      if (low < slack) overlap = Overlap::kPartial;
    }
    return overlap;
  }

 private:
  static double Dot(const Vec3& a, const Vec3& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
  static Vec3 Rotate(const Mat4& m, const Vec3& v) {
    const double norm = std::sqrt(Dot(v, v));
    Vec3 out;
    for (int k = 0; k < 3; ++k) out[k] = (m[4 * k] * v[0] + m[4 * k + 1] * v[1] + m[4 * k + 2] * v[2]) / norm;
    return out;
  }

  double near_;
  Vec3 origin_;
  Vec3 normals_[5];  // unit, pointing inwards
};

}  // namespace

OccupancyGrid::OccupancyGrid(int resolution) : resolution_(resolution) {
  if (resolution <= 0 || resolution > 1024 || resolution % kOccupancyBlock != 0) {
    throw InputError("the occupancy grid's resolution is " + std::to_string(resolution) +
                     "; give a multiple of 8 from 8 to 1024");
  }
  const int64_t n_cells = int64_t{resolution} * resolution * resolution;
  opacity_.assign(n_cells, kNeverMeasured);
  seen_.assign(n_cells / 64, ~uint64_t{0});
  occupied_ = seen_;
  SetBlocks();
}

std::array<int, 3> OccupancyGrid::CellAt(int64_t index) const {
  const int n = resolution_ / kOccupancyBlock;
  const auto block = static_cast<int>(index / kCellsPerBlock), within = static_cast<int>(index % kCellsPerBlock);
  return {block % n * kOccupancyBlock + (within & 7), block / n % n * kOccupancyBlock + ((within >> 3) & 7),
          block / (n * n) * kOccupancyBlock + (within >> 6)};
}

int64_t OccupancyGrid::IndexOf(int x, int y, int z) const {
  return static_cast<int64_t>(bits().BlockOf(x, y, z)) * kCellsPerBlock + (z & 7) * 64 + (y & 7) * 8 + (x & 7);
}

bool OccupancyGrid::Occupied(int x, int y, int z) const {
  return bits().CellOccupied(bits().BlockOf(x, y, z), x, y, z);
}

double OccupancyGrid::OccupiedFraction() const {
  return static_cast<double>(CountBits(occupied_)) / static_cast<double>(opacity_.size());
}

std::vector<int64_t> OccupancyGrid::ChooseCells(const UpdateOptions& options) const {
  std::vector<int64_t> cells;
  if (options.n_random == 0 && options.n_occupied == 0) {
    DrawBits(
        seen_, CountBits(seen_), [](int64_t) { return 0.; }, cells);
    return cells;
  }
  const uint64_t stream = StreamAt(RandomStream::kOccupancyCells, options.counter);
  DrawBits(
      seen_, options.n_random, [&](int64_t k) { return Uniform(options.seed, stream, k); }, cells);
  const auto n_before = static_cast<int64_t>(cells.size());
  DrawBits(
      occupied_, options.n_occupied, [&](int64_t k) { return Uniform(options.seed, stream, n_before + k); }, cells);
  return cells;
}

void OccupancyGrid::Measure(const DensitySource& field, const std::vector<int64_t>& cells,
                            const UpdateOptions& options) {
  const uint64_t stream = StreamAt(RandomStream::kOccupancyJitter, options.counter);
  const float cell_size = 2.F / static_cast<float>(resolution_);
  const auto step = static_cast<float>(options.step);
  const auto n_cells = static_cast<int64_t>(cells.size());
  std::vector<float> measured(n_cells);
  const int64_t n_at_once = std::min(field.points_at_once(), n_cells);
#pragma omp parallel for schedule(dynamic)
  for (int64_t begin = 0; begin < n_cells; begin += n_at_once) {
    const int64_t n = std::min(n_at_once, n_cells - begin);
    std::vector<float> points(3 * n);
    for (int64_t i = 0; i < n; ++i) {
      const std::array<int, 3> cell = CellAt(cells[begin + i]);
      for (int k = 0; k < 3; ++k) {
        const float jitter = Uniform(options.seed, stream, 3 * (begin + i) + k);
        points[3 * i + k] = (static_cast<float>(cell[k]) + jitter) * cell_size - 1;
      }
    }
    field.DensityOf(points.data(), n, &measured[begin]);
    for (int64_t i = 0; i < n; ++i) measured[begin + i] = -std::expm1(-measured[begin + i] * step);
  }
  for (int64_t i = 0; i < n_cells; ++i) {  // in order: a cell may have been drawn twice
    float& opacity = opacity_[cells[i]];
    opacity = std::max({options.decay * opacity, measured[i], 0.F});
  }
}

void OccupancyGrid::Update(const DensitySource& field, const UpdateOptions& options) {
  Measure(field, ChooseCells(options), options);
  SetOccupied(options.threshold, options.dilate);
}

void OccupancyGrid::SetOccupied(float threshold, bool dilate) {
  const auto n_words = static_cast<int64_t>(seen_.size());
  // Sums per word of 64 cells keep float's error far below what the threshold needs, and the order fixed.
  std::vector<float> sums(n_words);
#pragma omp parallel for schedule(static)
  for (int64_t w = 0; w < n_words; ++w) {
    for (int b = 0; b < 64; ++b) sums[w] += (seen_[w] >> b & 1) != 0 ? std::max(opacity_[w * 64 + b], 0.F) : 0.F;
  }
  double sum = 0;
  for (const float s : sums) sum += s;
  const auto n_seen = static_cast<double>(std::max<int64_t>(CountBits(seen_), 1));
  const float limit = std::min(threshold, static_cast<float>(sum / n_seen));
#pragma omp parallel for schedule(static)
  for (int64_t w = 0; w < n_words; ++w) {
    uint64_t word = 0;
    for (int b = 0; b < 64; ++b) {
      const float opacity = opacity_[w * 64 + b];
      word |= static_cast<uint64_t>(opacity >= limit || opacity == kNeverMeasured) << b;
    }
    occupied_[w] = word & seen_[w];
  }
  if (dilate) Dilate();
  SetBlocks();
}

void OccupancyGrid::Dilate() {
  const int n = resolution_;
  std::vector<uint8_t> dense(opacity_.size()), pooled(opacity_.size());
  const int64_t strides[3] = {1, n, int64_t{n} * n};
  for (int64_t i = 0; i < static_cast<int64_t>(dense.size()); ++i) {
    const auto [x, y, z] = CellAt(i);
    dense[z * strides[2] + y * strides[1] + x] = occupied_[i / 64] >> (i % 64) & 1;
  }
  for (const int64_t stride : strides) {  // separable
#pragma omp parallel for schedule(static)
    for (int64_t i = 0; i < static_cast<int64_t>(dense.size()); ++i) {
      const int64_t along = i / stride % n;
      pooled[i] = dense[i] | (along > 0 ? dense[i - stride] : 0) | (along < n - 1 ? dense[i + stride] : 0);
    }
    dense.swap(pooled);
  }
  for (int64_t i = 0; i < static_cast<int64_t>(dense.size()); ++i) {
    const auto [x, y, z] = CellAt(i);
    occupied_[i / 64] |= static_cast<uint64_t>(dense[z * strides[2] + y * strides[1] + x]) << (i % 64);
  }
  for (size_t w = 0; w < occupied_.size(); ++w) occupied_[w] &= seen_[w];
}

void OccupancyGrid::SetBlocks() {
  blocks_.assign(occupied_.size() / 8, 0);
  for (size_t w = 0; w < occupied_.size(); ++w) blocks_[w / 8] |= occupied_[w] != 0 ? 1 : 0;
}

void OccupancyGrid::MarkSeen(const std::vector<View>& views, const SceneMap& map, double near, int min_views) {
  std::vector<Frustum> frusta;
  frusta.reserve(views.size());
  for (const View& view : views) frusta.emplace_back(view, near);
  const auto n_blocks = static_cast<int64_t>(blocks_.size());
  const double cell_size = 2. / resolution_, half_block = 0.5 * kOccupancyBlock * cell_size;
#pragma omp parallel for schedule(dynamic, 16)
  for (int64_t block = 0; block < n_blocks; ++block) {
    // Views that see all of the block or nothing of it need no look at its cells.
    const std::array<int, 3> corner = CellAt(block * kCellsPerBlock);
    double center[3];
    for (int k = 0; k < 3; ++k) center[k] = corner[k] * cell_size + half_block - 1;
    const Corners block_corners = SceneCorners(map, center, half_block);
    int n_whole = 0;
    std::vector<const Frustum*> partial;
    for (const Frustum& frustum : frusta) {
      const Overlap overlap = frustum.With(block_corners);
      n_whole += overlap == Overlap::kWhole ? 1 : 0;
      if (overlap == Overlap::kPartial) partial.push_back(&frustum);
    }
    if (n_whole >= min_views) continue;
    for (int64_t i = block * kCellsPerBlock; i < (block + 1) * kCellsPerBlock; ++i) {
      const std::array<int, 3> cell = CellAt(i);
      for (int k = 0; k < 3; ++k) center[k] = (cell[k] + 0.5) * cell_size - 1;
      const Corners corners = SceneCorners(map, center, 0.5 * cell_size);
      int n_views = n_whole;
      for (size_t p = 0; p < partial.size() && n_views < min_views; ++p) {
        n_views += partial[p]->With(corners) != Overlap::kNone ? 1 : 0;
      }
      const uint64_t bit = uint64_t{1} << (i % 64);
      if (n_views < min_views) seen_[i / 64] &= ~bit;
    }
  }
  for (size_t w = 0; w < occupied_.size(); ++w) occupied_[w] &= seen_[w];
  SetBlocks();
}

// The occupied cells in components of at least `stray` of them all.
std::vector<uint64_t> OccupancyGrid::WithoutStrays(double stray) const {
  const auto fewest = static_cast<size_t>(std::ceil(stray * static_cast<double>(CountBits(occupied_))));
  std::vector<uint64_t> left = occupied_, kept(occupied_.size());
  const auto take = [&left](int64_t i) {
    const uint64_t bit = uint64_t{1} << (i % 64);
    const bool there = (left[i / 64] & bit) != 0;
    left[i / 64] &= ~bit;
    return there;
  };
  std::vector<int64_t> component;
  for (int64_t seed = 0; seed < static_cast<int64_t>(opacity_.size()); ++seed) {
    if (!take(seed)) continue;
    component.assign(1, seed);
    for (size_t next = 0; next < component.size(); ++next) {
      const auto [x, y, z] = CellAt(component[next]);
      for (int n = 0; n < 27; ++n) {
        const int at[3] = {x + n % 3 - 1, y + n / 3 % 3 - 1, z + n / 9 - 1};
        if (std::any_of(at, at + 3, [this](int c) { return c < 0 || c >= resolution_; })) continue;
        const int64_t i = IndexOf(at[0], at[1], at[2]);
        if (take(i)) component.push_back(i);
      }
    }
    if (component.size() < fewest) continue;
    for (const int64_t i : component) kept[i / 64] |= uint64_t{1} << (i % 64);
  }
  return kept;
}

OccupancyGrid::Box OccupancyGrid::OccupiedBox(double stray) const {
  const std::vector<uint64_t> cells = stray > 0 ? WithoutStrays(stray) : occupied_;
  std::array<int, 3> low{resolution_, resolution_, resolution_}, high{0, 0, 0};
  for (int64_t i = 0; i < static_cast<int64_t>(opacity_.size()); ++i) {
    if ((cells[i / 64] >> (i % 64) & 1) == 0) continue;
    const std::array<int, 3> cell = CellAt(i);
    for (int k = 0; k < 3; ++k) {
      low[k] = std::min(low[k], cell[k]);
      high[k] = std::max(high[k], cell[k] + 1);
    }
  }
  if (low[0] >= high[0]) return {{-1, -1, -1}, {1, 1, 1}};
  Box box{};
  for (int k = 0; k < 3; ++k) {
    box.min[k] = 2. * low[k] / resolution_ - 1;
    box.max[k] = 2. * high[k] / resolution_ - 1;
  }
  return box;
}

OccupancyGrid OccupancyGrid::FromState(State state) {
  const bool possible = state.resolution > 0 && state.resolution <= 1024 && state.resolution % kOccupancyBlock == 0;
  const size_t n_cells = possible ? size_t(state.resolution) * state.resolution * state.resolution : 0;
  if (!possible || state.opacity.size() != n_cells || state.seen.size() != n_cells / 64 ||
      state.occupied.size() != n_cells / 64) {
    throw CorruptError("the stored occupancy grid has resolution " + std::to_string(state.resolution) + " but " +
                       std::to_string(state.opacity.size()) + " cells; train the model again");
  }
  OccupancyGrid grid(state.resolution);
  grid.opacity_ = std::move(state.opacity);
  grid.seen_ = std::move(state.seen);
  grid.occupied_ = std::move(state.occupied);
  grid.SetBlocks();
  return grid;
}

}  // namespace nrff
