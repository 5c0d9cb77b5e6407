#include <algorithm>
#include <cmath>
#include <cstring>
#include <stdexcept>

#include "model/kernels/feature_grid.h"
#include "model/kernels/simd.h"

namespace nrff {

GridLayout MakeGridLayout(int n_levels, int base_resolution, int max_resolution, int n_channels, int n_left_out) {
  constexpr int kGroup = 4;  // channels that kernels work on at once
  if (n_left_out < 0 || n_levels <= n_left_out || base_resolution < 2 || max_resolution < base_resolution ||
      (n_channels != 2 && (n_channels < kGroup || n_channels % kGroup != 0))) {
    throw std::invalid_argument(
        "grid layout: need levels that are not all left out, 2 <= base <= max resolution, channels 2 or a multiple of 4");
  }
  if (n_levels == 1 && base_resolution != max_resolution) {
    throw std::invalid_argument("grid layout: a single level has one resolution, base = max");
  }
  GridLayout layout;
  layout.n_channels = std::min(n_channels, kGroup);
  const double log_growth = n_levels > 1 ? std::log(double(max_resolution) / base_resolution) / (n_levels - 1) : 0;
  for (int l = 0; l < n_levels - n_left_out; ++l) {
    GridLayout::Level level{};
    // The small term keeps levels that are whole numbers from being rounded down.
    level.resolution = int(std::floor(base_resolution * std::exp(l * log_growth) + 1e-9));
    const int64_t n_line = int64_t(level.resolution) * layout.n_channels;
    for (int c = 0; c < n_channels; c += layout.n_channels) {
      for (int64_t& offset : level.plane_offsets) {
        offset = layout.n_parameters;
        layout.n_parameters += level.resolution * n_line;
      }
      for (int64_t& offset : level.line_offsets) {
        offset = layout.n_parameters;
        layout.n_parameters += n_line;
      }
      layout.levels.push_back(level);
    }
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

// (1 − fraction) for the lanes of the first node, fraction for those of the second.
template <typename Scalar, int C>
NRFF_INLINE void EndWeights(Scalar fraction, Pair<Scalar, C>& weights) {
  Pair<Scalar, C> first{}, slope{};
  for (int c = 0; c < C; ++c) {
    first[c] = 1;
    slope[c] = -1;
    slope[C + c] = 1;
  }
  weights = first + slope * fraction;
}

// The two nodes' sum, for both.
template <typename Scalar, int C>
NRFF_INLINE void SumOfEnds(const Pair<Scalar, C>& pair, Pair<Scalar, C>& sum) {
  if constexpr (C == 2) {
    sum = pair + __builtin_shufflevector(pair, pair, 2, 3, 0, 1);
  } else {
    sum = pair + __builtin_shufflevector(pair, pair, 4, 5, 6, 7, 0, 1, 2, 3);
  }
}

// Where the points of a block lie among a level's nodes, along one axis.
template <typename Scalar>
struct Positions {
  int32_t cell[kBlock];
  Scalar fraction[kBlock];

  NRFF_INLINE void Find(const Scalar* points, int axis, int resolution, int64_t n) {
    const Scalar last = Scalar(resolution - 1), scale = Scalar(0.5) * last;
    const int last_cell = resolution - 2;
    for (int64_t i = 0; i < n; ++i) {
      Scalar node = (points[3 * i + axis] + 1) * scale;
      node = node > 0 ? node : 0;  // also for NaN
      node = node < last ? node : last;
      int at = int(node);
      at = at < last_cell ? at : last_cell;
      cell[i] = at;
      fraction[i] = node - Scalar(at);
    }
  }
};

// One plane ⊙ line product of one level for the points of a block: where its nodes lie, in elements.
template <typename Scalar, int C>
struct Product {
  const Scalar *columns, *rows, *lines;  // fractions
  int64_t row_stride;
  int64_t plane[kBlock], line[kBlock];

  NRFF_INLINE void Find(const GridLayout::Level& level, int p, const Positions<Scalar>* axes, int64_t n) {
    const auto [column_axis, row_axis, line_axis] = std::array{
        kGridProducts[p].column_axis, kGridProducts[p].row_axis, kGridProducts[p].line_axis};
    columns = axes[column_axis].fraction;
    rows = axes[row_axis].fraction;
    lines = axes[line_axis].fraction;
    row_stride = int64_t(level.resolution) * C;
    const int32_t *column = axes[column_axis].cell, *row = axes[row_axis].cell, *node = axes[line_axis].cell;
    const int64_t plane_offset = level.plane_offsets[p], line_offset = level.line_offsets[p];
    for (int64_t i = 0; i < n; ++i) {
      plane[i] = plane_offset + C * int64_t(row[i] * level.resolution + column[i]);
      line[i] = line_offset + C * int64_t(node[i]);
    }
  }

  // The plane's values at both columns, weighted, and the line's value twice: their product's two halves sum to the
  // C values.
  NRFF_INLINE void Read(const Scalar* parameters, int64_t i, Pair<Scalar, C>& plane_pair,
                        Pair<Scalar, C>& line_value) const {
    Pair<Scalar, C> low, high, ends, column_weights, line_weights;
    Load(parameters + plane[i], low);
    Load(parameters + plane[i] + row_stride, high);
    Load(parameters + line[i], ends);
    EndWeights<Scalar, C>(columns[i], column_weights);
    EndWeights<Scalar, C>(lines[i], line_weights);
    plane_pair = (low + (high - low) * rows[i]) * column_weights;
    SumOfEnds<Scalar, C>(ends * line_weights, line_value);
  }

  // d_value: gradient of the C values, twice.
  NRFF_INLINE void Scatter(const Scalar* parameters, int64_t i, const Pair<Scalar, C>& d_value,
                           Scalar* d_parameters) const {
    Pair<Scalar, C> low, high, ends, column_weights, line_weights, plane_value, line_value;
    Load(parameters + plane[i], low);
    Load(parameters + plane[i] + row_stride, high);
    Load(parameters + line[i], ends);
    EndWeights<Scalar, C>(columns[i], column_weights);
    EndWeights<Scalar, C>(lines[i], line_weights);
    SumOfEnds<Scalar, C>((low + (high - low) * rows[i]) * column_weights, plane_value);
    SumOfEnds<Scalar, C>(ends * line_weights, line_value);
    const Pair<Scalar, C> d_plane = d_value * line_value * column_weights;
    const Pair<Scalar, C> d_high = d_plane * rows[i];
    AddTo(d_parameters + plane[i], d_plane - d_high);
    AddTo(d_parameters + plane[i] + row_stride, d_high);
    AddTo(d_parameters + line[i], d_value * plane_value * line_weights);
  }
};

// Calls work(begin, n) for blocks of points.
template <typename Work>
NRFF_INLINE void ForBlocks(int64_t n, Work work) {
  for (int64_t begin = 0; begin < n; begin += kBlock) work(begin, std::min(kBlock, n - begin));
}

template <typename Scalar, int C>
NRFF_INLINE void ConcatForward(const GridLayout& layout, const Scalar* parameters, const Scalar* points, int64_t n,
                               Scalar* features) {
  ForBlocks(n, [=, &layout](int64_t begin, int64_t n_block) NRFF_LAMBDA_INLINE {
    Positions<Scalar> axes[3];
    Product<Scalar, C> product;
    for (size_t l = 0; l < layout.levels.size(); ++l) {
      const GridLayout::Level& level = layout.levels[l];
      for (int axis = 0; axis < 3; ++axis) axes[axis].Find(points + 3 * begin, axis, level.resolution, n_block);
      for (int p = 0; p < 3; ++p) {
        product.Find(level, p, axes, n_block);
        Scalar* out = features + (int64_t(l * 3 + p) * n + begin) * C;
        for (int64_t i = 0; i < n_block; ++i) {
          Pair<Scalar, C> plane, line;
          product.Read(parameters, i, plane, line);
          SumOfEnds<Scalar, C>(plane * line, plane);
          std::memcpy(out + i * C, &plane, C * sizeof(Scalar));
        }
      }
    }
  });
}

template <typename Scalar, int C>
NRFF_INLINE void SumForward(const GridLayout& layout, const Scalar* parameters, const Scalar* points, int64_t n,
                            Scalar* feature) {
  ForBlocks(n, [=, &layout](int64_t begin, int64_t n_block) NRFF_LAMBDA_INLINE {
    Positions<Scalar> axes[3];
    Product<Scalar, C> product;
    Pair<Scalar, C> sums[kBlock] = {};
    for (const GridLayout::Level& level : layout.levels) {
      for (int axis = 0; axis < 3; ++axis) axes[axis].Find(points + 3 * begin, axis, level.resolution, n_block);
      for (int p = 0; p < 3; ++p) {
        product.Find(level, p, axes, n_block);
        for (int64_t i = 0; i < n_block; ++i) {
          Pair<Scalar, C> plane, line;
          product.Read(parameters, i, plane, line);
          sums[i] += plane * line;
        }
      }
    }
    for (int64_t i = 0; i < n_block; ++i) {
      Scalar sum = 0;
      for (int c = 0; c < 2 * C; ++c) sum += sums[i][c];
      feature[begin + i] = sum;
    }
  });
}

// Calls scatter(product, i within the block, i) for all points.
template <typename Scalar, int C, typename Scatter>
NRFF_INLINE void ForScattered(const GridLayout& layout, int row, const Scalar* points, int64_t n, Scatter scatter) {
  const GridLayout::Level& level = layout.levels[row / 3];
  Positions<Scalar> axes[3];
  Product<Scalar, C> product;
  for (int64_t begin = 0; begin < n; begin += kBlock) {
    const int64_t n_block = std::min(kBlock, n - begin);
    for (int axis = 0; axis < 3; ++axis) axes[axis].Find(points + 3 * begin, axis, level.resolution, n_block);
    product.Find(level, row % 3, axes, n_block);
    for (int64_t i = 0; i < n_block; ++i) scatter(product, i, begin + i);
  }
}

template <typename Scalar, int C>
NRFF_INLINE void ConcatBackward(const GridLayout& layout, int row, const Scalar* parameters, const Scalar* points,
                                int64_t n, const Scalar* d_features, Scalar* d_parameters) {
  ForScattered<Scalar, C>(layout, row, points, n,
                          [=](const Product<Scalar, C>& product, int64_t i, int64_t at) NRFF_LAMBDA_INLINE {
                            Node<Scalar, C> d_value;
                            Pair<Scalar, C> twice;
                            Load(d_features + at * C, d_value);
                            if constexpr (C == 2) {
                              twice = __builtin_shufflevector(d_value, d_value, 0, 1, 0, 1);
                            } else {
                              twice = __builtin_shufflevector(d_value, d_value, 0, 1, 2, 3, 0, 1, 2, 3);
                            }
                            product.Scatter(parameters, i, twice, d_parameters);
                          });
}

template <typename Scalar, int C>
NRFF_INLINE void SumBackward(const GridLayout& layout, int row, const Scalar* parameters, const Scalar* points,
                             int64_t n, const Scalar* d_feature, Scalar* d_parameters) {
  ForScattered<Scalar, C>(layout, row, points, n,
                          [=](const Product<Scalar, C>& product, int64_t i, int64_t at) NRFF_LAMBDA_INLINE {
                            product.Scatter(parameters, i, Pair<Scalar, C>{} + d_feature[at], d_parameters);
                          });
}

// Per scalar type because multiversioned functions cannot be templates.
// NOLINTBEGIN(bugprone-macro-parentheses): a type cannot stand in parentheses
#define NRFF_GRID_KERNEL(Scalar, Name, ...)                        \
  if (layout.n_channels == 2) Name<Scalar, 2>(layout, __VA_ARGS__); \
  if (layout.n_channels == 4) Name<Scalar, 4>(layout, __VA_ARGS__)
#define NRFF_GRID_KERNELS(Scalar)                                                                                      \
  NRFF_MULTIVERSION void ConcatForwardOf(const GridLayout& layout, const Scalar* parameters, const Scalar* points,     \
                                         int64_t n, Scalar* features) {                                                \
    NRFF_GRID_KERNEL(Scalar, ConcatForward, parameters, points, n, features);                                          \
  }                                                                                                                    \
  NRFF_MULTIVERSION void SumForwardOf(const GridLayout& layout, const Scalar* parameters, const Scalar* points,        \
                                      int64_t n, Scalar* feature) {                                                    \
    NRFF_GRID_KERNEL(Scalar, SumForward, parameters, points, n, feature);                                              \
  }                                                                                                                    \
  NRFF_MULTIVERSION void ConcatBackwardOf(const GridLayout& layout, int row, const Scalar* parameters,                 \
                                          const Scalar* points, int64_t n, const Scalar* d_features,                   \
                                          Scalar* d_parameters) {                                                      \
    NRFF_GRID_KERNEL(Scalar, ConcatBackward, row, parameters, points, n, d_features, d_parameters);                    \
  }                                                                                                                    \
  NRFF_MULTIVERSION void SumBackwardOf(const GridLayout& layout, int row, const Scalar* parameters,                    \
                                       const Scalar* points, int64_t n, const Scalar* d_feature, Scalar* d_parameters) { \
    NRFF_GRID_KERNEL(Scalar, SumBackward, row, parameters, points, n, d_feature, d_parameters);                        \
  }
NRFF_GRID_KERNELS(float)
NRFF_GRID_KERNELS(double)
#undef NRFF_GRID_KERNELS
#undef NRFF_GRID_KERNEL
// NOLINTEND(bugprone-macro-parentheses)

}  // namespace

template <typename Scalar>
void GridConcatForward(const GridLayout& layout, const Scalar* parameters, const Scalar* points, int64_t n,
                       Scalar* features) {
  ConcatForwardOf(layout, parameters, points, n, features);
}

template <typename Scalar>
void GridConcatBackward(const GridLayout& layout, int product, const Scalar* parameters, const Scalar* points,
                        int64_t n, const Scalar* d_features, Scalar* d_parameters) {
  ConcatBackwardOf(layout, product, parameters, points, n, d_features, d_parameters);
}

template <typename Scalar>
void GridSumForward(const GridLayout& layout, const Scalar* parameters, const Scalar* points, int64_t n,
                    Scalar* feature) {
  SumForwardOf(layout, parameters, points, n, feature);
}

template <typename Scalar>
void GridSumBackward(const GridLayout& layout, int product, const Scalar* parameters, const Scalar* points, int64_t n,
                     const Scalar* d_feature, Scalar* d_parameters) {
  SumBackwardOf(layout, product, parameters, points, n, d_feature, d_parameters);
}

template void GridConcatForward(const GridLayout&, const float*, const float*, int64_t, float*);
template void GridConcatForward(const GridLayout&, const double*, const double*, int64_t, double*);
template void GridConcatBackward(const GridLayout&, int, const float*, const float*, int64_t, const float*, float*);
template void GridConcatBackward(const GridLayout&, int, const double*, const double*, int64_t, const double*,
                                 double*);
template void GridSumForward(const GridLayout&, const float*, const float*, int64_t, float*);
template void GridSumForward(const GridLayout&, const double*, const double*, int64_t, double*);
template void GridSumBackward(const GridLayout&, int, const float*, const float*, int64_t, const float*, float*);
template void GridSumBackward(const GridLayout&, int, const double*, const double*, int64_t, const double*, double*);

}  // namespace nrff
