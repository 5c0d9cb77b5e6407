#include <algorithm>
#include <cmath>
#include <cstring>
#include <stdexcept>

#include "model/kernels/feature_grid.h"
#include "model/kernels/simd.h"

namespace nrff {

GridLayout MakeGridLayout(int n_levels, int base_resolution, int max_resolution, int n_channels) {
  if (n_levels < 1 || base_resolution < 2 || max_resolution < base_resolution || (n_channels != 2 && n_channels != 4)) {
    throw std::invalid_argument("grid layout: need levels >= 1, 2 <= base <= max resolution, 2 or 4 channels");
  }
  GridLayout layout;
  layout.n_channels = n_channels;
  const double log_growth = n_levels > 1 ? std::log(double(max_resolution) / base_resolution) / (n_levels - 1) : 0;
  for (int l = 0; l < n_levels; ++l) {
    GridLayout::Level level{};
    // The small term keeps levels that are whole numbers from being rounded down.
    level.resolution = int(std::floor(base_resolution * std::exp(l * log_growth) + 1e-9));
    for (int64_t& offset : level.plane_offsets) {
      offset = layout.n_parameters;
      layout.n_parameters += int64_t(level.resolution) * level.resolution * n_channels;
    }
    for (int64_t& offset : level.line_offsets) {
      offset = layout.n_parameters;
      layout.n_parameters += int64_t(level.resolution) * n_channels;
    }
    layout.levels.push_back(level);
  }
  return layout;
}

namespace {

constexpr int64_t kBlock = 128;  // points whose work on one level is done together, so that the level stays in cache

// C channels of two neighbouring nodes lie side by side: 2C lanes are read and written at once.
template <typename Scalar, int C>
struct Lanes {
  typedef Scalar Pair __attribute__((vector_size(2 * C * sizeof(Scalar))));
  typedef Scalar Node __attribute__((vector_size(C * sizeof(Scalar))));
};
template <typename Scalar, int C>
using Pair = typename Lanes<Scalar, C>::Pair;
template <typename Scalar, int C>
using Node = typename Lanes<Scalar, C>::Node;

template <typename Vector, typename Scalar>
NRFF_INLINE void Load(const Scalar* from, Vector& to) {
  std::memcpy(&to, from, sizeof(Vector));
}

template <typename Vector, typename Scalar>
NRFF_INLINE void AddTo(Scalar* to, const Vector& what) {
  Vector sum;
  std::memcpy(&sum, to, sizeof(Vector));
  sum += what;
  std::memcpy(to, &sum, sizeof(Vector));
}

// The two nodes' sum.
template <typename Scalar, int C>
NRFF_INLINE void Fold(const Pair<Scalar, C>& pair, Node<Scalar, C>& sum) {
  Node<Scalar, C> halves[2];
  std::memcpy(halves, &pair, sizeof(pair));
  sum = halves[0] + halves[1];
}

// node · weight, for both nodes.
template <typename Scalar, int C>
NRFF_INLINE void Spread(const Node<Scalar, C>& node, Scalar weight0, Scalar weight1, Pair<Scalar, C>& pair) {
  const Node<Scalar, C> halves[2] = {node * weight0, node * weight1};
  std::memcpy(&pair, halves, sizeof(pair));
}

// Cell and position in it along one axis.
template <typename Scalar>
struct Position {
  int cell;
  Scalar fraction;
};

template <typename Scalar>
NRFF_INLINE Position<Scalar> Locate(Scalar coordinate, int resolution) {
  Scalar node = (coordinate + 1) * (Scalar(0.5) * Scalar(resolution - 1));
  node = node > 0 ? node : 0;  // also for NaN
  node = node < Scalar(resolution - 1) ? node : Scalar(resolution - 1);
  const int cell = std::min(int(node), resolution - 2);
  return {cell, node - Scalar(cell)};
}

// One plane ⊙ line product at one point: the interpolated values, and where they came from.
template <typename Scalar, int C>
struct ProductAt {
  Pair<Scalar, C> column_weights, line_weights;
  Node<Scalar, C> plane_value, line_value;
  Position<Scalar> row, line;
  int64_t plane_index, line_index;
  int64_t row_stride;

  NRFF_INLINE void Read(const GridProduct& product, const GridLayout::Level& level, int p, const Scalar* parameters,
                        const Scalar* point) {
    const Position<Scalar> column = Locate(point[product.column_axis], level.resolution);
    row = Locate(point[product.row_axis], level.resolution);
    line = Locate(point[product.line_axis], level.resolution);
    row_stride = int64_t(level.resolution) * C;
    plane_index = level.plane_offsets[p] + row.cell * row_stride + int64_t(column.cell) * C;
    line_index = level.line_offsets[p] + int64_t(line.cell) * C;
    const Node<Scalar, C> ones = Node<Scalar, C>{} + 1;
    Spread<Scalar, C>(ones, 1 - column.fraction, column.fraction, column_weights);
    Spread<Scalar, C>(ones, 1 - line.fraction, line.fraction, line_weights);
    Pair<Scalar, C> low, high, ends;
    Load(parameters + plane_index, low);
    Load(parameters + plane_index + row_stride, high);
    Load(parameters + line_index, ends);
    Fold<Scalar, C>((low * (1 - row.fraction) + high * row.fraction) * column_weights, plane_value);
    Fold<Scalar, C>(ends * line_weights, line_value);
  }

  // d_value: gradient of the product's C values.
  NRFF_INLINE void Scatter(const Node<Scalar, C>& d_value, Scalar* d_parameters) const {
    const Node<Scalar, C> d_plane = d_value * line_value;
    const Node<Scalar, C> d_line = d_value * plane_value;
    Pair<Scalar, C> spread;
    Spread<Scalar, C>(d_plane, 1, 1, spread);
    spread *= column_weights;
    AddTo(d_parameters + plane_index, spread * (1 - row.fraction));
    AddTo(d_parameters + plane_index + row_stride, spread * row.fraction);
    Spread<Scalar, C>(d_line, 1 - line.fraction, line.fraction, spread);
    AddTo(d_parameters + line_index, spread);
  }
};

template <typename Scalar, int C>
NRFF_INLINE void ConcatForward(const GridLayout& layout, const Scalar* parameters, const Scalar* points, int64_t begin,
                               int64_t end, Scalar* features) {
  const int64_t stride = layout.n_features();
  for (size_t l = 0; l < layout.levels.size(); ++l) {
    for (int p = 0; p < 3; ++p) {
      const int64_t column = int64_t(l * 3 + p) * C;
      for (int64_t i = begin; i < end; ++i) {
        ProductAt<Scalar, C> at;
        at.Read(kGridProducts[p], layout.levels[l], p, parameters, points + 3 * i);
        const Node<Scalar, C> value = at.plane_value * at.line_value;
        std::memcpy(features + i * stride + column, &value, sizeof(value));
      }
    }
  }
}

template <typename Scalar, int C>
NRFF_INLINE void SumForward(const GridLayout& layout, const Scalar* parameters, const Scalar* points, int64_t begin,
                            int64_t end, Scalar* feature) {
  Node<Scalar, C> sums[kBlock] = {};
  for (const GridLayout::Level& level : layout.levels) {
    for (int p = 0; p < 3; ++p) {
      for (int64_t i = begin; i < end; ++i) {
        ProductAt<Scalar, C> at;
        at.Read(kGridProducts[p], level, p, parameters, points + 3 * i);
        sums[i - begin] += at.plane_value * at.line_value;
      }
    }
  }
  for (int64_t i = begin; i < end; ++i) {
    Scalar sum = 0;
    for (int c = 0; c < C; ++c) sum += sums[i - begin][c];
    feature[i] = sum;
  }
}

template <typename Scalar, int C>
NRFF_INLINE void ConcatBackward(const GridLayout& layout, int l, int p, const Scalar* parameters, const Scalar* points,
                                int64_t n, const Scalar* d_features, Scalar* d_parameters) {
  const int64_t stride = layout.n_features();
  for (int64_t i = 0; i < n; ++i) {
    Node<Scalar, C> d_value;
    Load(d_features + i * stride + int64_t(l * 3 + p) * C, d_value);
    ProductAt<Scalar, C> at;
    at.Read(kGridProducts[p], layout.levels[l], p, parameters, points + 3 * i);
    at.Scatter(d_value, d_parameters);
  }
}

template <typename Scalar, int C>
NRFF_INLINE void SumBackward(const GridLayout& layout, int l, int p, const Scalar* parameters, const Scalar* points,
                             int64_t n, const Scalar* d_feature, Scalar* d_parameters) {
  for (int64_t i = 0; i < n; ++i) {
    if (d_feature[i] == 0) continue;  // many samples lie behind what their ray ends at
    ProductAt<Scalar, C> at;
    at.Read(kGridProducts[p], layout.levels[l], p, parameters, points + 3 * i);
    at.Scatter(Node<Scalar, C>{} + d_feature[i], d_parameters);
  }
}

// The units of work of one thread, per scalar type because multiversioned functions cannot be templates.
// NOLINTBEGIN(bugprone-macro-parentheses): a type cannot stand in parentheses
#define NRFF_GRID_KERNELS(Scalar)                                                                                     \
  NRFF_MULTIVERSION void ConcatForwardBlock(const GridLayout& layout, const Scalar* parameters, const Scalar* points, \
                                            int64_t begin, int64_t end, Scalar* features) {                           \
    if (layout.n_channels == 2)                                                                                       \
      ConcatForward<Scalar, 2>(layout, parameters, points, begin, end, features);                                     \
    else                                                                                                              \
      ConcatForward<Scalar, 4>(layout, parameters, points, begin, end, features);                                     \
  }                                                                                                                   \
  NRFF_MULTIVERSION void SumForwardBlock(const GridLayout& layout, const Scalar* parameters, const Scalar* points,    \
                                         int64_t begin, int64_t end, Scalar* feature) {                               \
    if (layout.n_channels == 2)                                                                                       \
      SumForward<Scalar, 2>(layout, parameters, points, begin, end, feature);                                         \
    else                                                                                                              \
      SumForward<Scalar, 4>(layout, parameters, points, begin, end, feature);                                         \
  }                                                                                                                   \
  NRFF_MULTIVERSION void ConcatBackwardProduct(const GridLayout& layout, int l, int p, const Scalar* parameters,      \
                                               const Scalar* points, int64_t n, const Scalar* d_features,             \
                                               Scalar* d_parameters) {                                                \
    if (layout.n_channels == 2)                                                                                       \
      ConcatBackward<Scalar, 2>(layout, l, p, parameters, points, n, d_features, d_parameters);                       \
    else                                                                                                              \
      ConcatBackward<Scalar, 4>(layout, l, p, parameters, points, n, d_features, d_parameters);                       \
  }                                                                                                                   \
  NRFF_MULTIVERSION void SumBackwardProduct(const GridLayout& layout, int l, int p, const Scalar* parameters,         \
                                            const Scalar* points, int64_t n, const Scalar* d_feature,                 \
                                            Scalar* d_parameters) {                                                   \
    if (layout.n_channels == 2)                                                                                       \
      SumBackward<Scalar, 2>(layout, l, p, parameters, points, n, d_feature, d_parameters);                           \
    else                                                                                                              \
      SumBackward<Scalar, 4>(layout, l, p, parameters, points, n, d_feature, d_parameters);                           \
  }

NRFF_GRID_KERNELS(float)
NRFF_GRID_KERNELS(double)
#undef NRFF_GRID_KERNELS
// NOLINTEND(bugprone-macro-parentheses)

// Calls work(begin, end) for blocks of points, in parallel.
template <typename Work>
void ForEachBlock(int64_t n, const Work& work) {
  const int64_t n_blocks = (n + kBlock - 1) / kBlock;
#pragma omp parallel for schedule(static)
  for (int64_t block = 0; block < n_blocks; ++block) work(block * kBlock, std::min(n, (block + 1) * kBlock));
}

// Calls work(level, product) for all, in parallel: each owns its part of the gradient. Fine levels, which are slowest,
// come first.
template <typename Work>
void ForEachProduct(const GridLayout& layout, const Work& work) {
  const int n_tasks = int(layout.levels.size()) * 3;
#pragma omp parallel for schedule(dynamic)
  for (int task = n_tasks - 1; task >= 0; --task) work(task / 3, task % 3);
}

}  // namespace

template <typename Scalar>
void GridConcatForward(const GridLayout& layout, const Scalar* parameters, const Scalar* points, int64_t n,
                       Scalar* features) {
  ForEachBlock(
      n, [&](int64_t begin, int64_t end) { ConcatForwardBlock(layout, parameters, points, begin, end, features); });
}

template <typename Scalar>
void GridConcatBackward(const GridLayout& layout, const Scalar* parameters, const Scalar* points, int64_t n,
                        const Scalar* d_features, Scalar* d_parameters) {
  ForEachProduct(layout, [&](int l, int p) {
    ConcatBackwardProduct(layout, l, p, parameters, points, n, d_features, d_parameters);
  });
}

template <typename Scalar>
void GridSumForward(const GridLayout& layout, const Scalar* parameters, const Scalar* points, int64_t n,
                    Scalar* feature) {
  ForEachBlock(n,
               [&](int64_t begin, int64_t end) { SumForwardBlock(layout, parameters, points, begin, end, feature); });
}

template <typename Scalar>
void GridSumBackward(const GridLayout& layout, const Scalar* parameters, const Scalar* points, int64_t n,
                     const Scalar* d_feature, Scalar* d_parameters) {
  ForEachProduct(
      layout, [&](int l, int p) { SumBackwardProduct(layout, l, p, parameters, points, n, d_feature, d_parameters); });
}

template void GridConcatForward(const GridLayout&, const float*, const float*, int64_t, float*);
template void GridConcatForward(const GridLayout&, const double*, const double*, int64_t, double*);
template void GridConcatBackward(const GridLayout&, const float*, const float*, int64_t, const float*, float*);
template void GridConcatBackward(const GridLayout&, const double*, const double*, int64_t, const double*, double*);
template void GridSumForward(const GridLayout&, const float*, const float*, int64_t, float*);
template void GridSumForward(const GridLayout&, const double*, const double*, int64_t, double*);
template void GridSumBackward(const GridLayout&, const float*, const float*, int64_t, const float*, float*);
template void GridSumBackward(const GridLayout&, const double*, const double*, int64_t, const double*, double*);

}  // namespace nrff
