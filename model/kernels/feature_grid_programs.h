// The feature grids of feature_grid.h as kernels of device_runtime.h. Their gradients are sums by atomic additions, so
// their last bits change from run to run.
#pragma once

#include <cmath>
#include <cstdint>
#include <stdexcept>

#include "model/kernels/fast_math.h"
#include "model/kernels/feature_grid.h"
#include "render/kernels/device_runtime.h"

namespace nrff::device {

inline constexpr int kMaxGridLevels = 64;

// A GridLayout without memory of its own.
struct GridLevels {
  int n_channels = 0, n_levels = 0;
  struct Level {
    int resolution;
    int64_t plane_offsets[3], line_offsets[3];
  } levels[kMaxGridLevels];

  explicit GridLevels(const GridLayout& layout)
      : n_channels(layout.n_channels), n_levels(static_cast<int>(layout.levels.size())) {
    if (n_levels > kMaxGridLevels) throw std::invalid_argument("grid: at most 64 levels of up to 4 channels on a GPU");
    for (int l = 0; l < n_levels; ++l) {
      levels[l].resolution = layout.levels[l].resolution;
      for (int p = 0; p < 3; ++p) {
        levels[l].plane_offsets[p] = layout.levels[l].plane_offsets[p];
        levels[l].line_offsets[p] = layout.levels[l].line_offsets[p];
      }
    }
  }
};

// Where a coordinate lies among the nodes of an axis.
struct GridPosition {
  int cell;
  float fraction;
  NRFF_HOST_DEVICE GridPosition(float coordinate, int resolution) {
    const auto last = static_cast<float>(resolution - 1);
    float node = (coordinate + 1) * (0.5F * last);
    node = node > 0 ? node : 0;  // also for NaN
    node = node < last ? node : last;
    cell = static_cast<int>(node);
    cell = cell < resolution - 2 ? cell : resolution - 2;
    fraction = node - static_cast<float>(cell);
  }
};

// One plane ⊙ line product of C channels at a point.
template <typename Table, int C>
struct GridProductAt {
  GridPosition column, row, node;
  int64_t plane, line, row_stride;  // elements
  float plane_value[C], line_value[C];

  NRFF_HOST_DEVICE GridProductAt(const GridLevels::Level& level, int p, const Table* table, const float* point)
      : column(point[p == 0 ? 1 : 0], level.resolution),
        row(point[p == 2 ? 1 : 2], level.resolution),
        node(point[p], level.resolution),
        plane(level.plane_offsets[p] + C * (static_cast<int64_t>(row.cell) * level.resolution + column.cell)),
        line(level.line_offsets[p] + C * static_cast<int64_t>(node.cell)),
        row_stride(static_cast<int64_t>(level.resolution) * C) {
    for (int c = 0; c < C; ++c) {
      const float low = Between(table[plane + c], table[plane + C + c], column.fraction);
      const float high = Between(table[plane + row_stride + c], table[plane + row_stride + C + c], column.fraction);
      plane_value[c] = low + (high - low) * row.fraction;
      line_value[c] = Between(table[line + c], table[line + C + c], node.fraction);
    }
  }

  NRFF_HOST_DEVICE void Scatter(const float* d_value, float* gradient) const {
    float d_plane[C], d_line[C];
    for (int c = 0; c < C; ++c) {
      d_plane[c] = d_value[c] * line_value[c];
      d_line[c] = d_value[c] * plane_value[c];
    }
    Add(gradient + plane, d_plane, (1 - row.fraction) * (1 - column.fraction));
    Add(gradient + plane + C, d_plane, (1 - row.fraction) * column.fraction);
    Add(gradient + plane + row_stride, d_plane, row.fraction * (1 - column.fraction));
    Add(gradient + plane + row_stride + C, d_plane, row.fraction * column.fraction);
    Add(gradient + line, d_line, 1 - node.fraction);
    Add(gradient + line + C, d_line, node.fraction);
  }

 private:
  NRFF_HOST_DEVICE static float Between(Table a, Table b, float fraction) {
    const float low = ToFloat(a), high = ToFloat(b);
    return low + (high - low) * fraction;
  }
  NRFF_HOST_DEVICE static void Add(float* to, const float* values, float weight) {
    if constexpr (C == 2) {
      AtomicAdd2(to, weight * values[0], weight * values[1]);
    } else {
      const float weighted[4] = {weight * values[0], weight * values[1], weight * values[2], weight * values[3]};
      AtomicAdd4(to, weighted);
    }
  }
};

// Columns 0 … n_features − 1 of features [room for points][feature_row] are those of the appearance grid, the others
// and the rows of points that there are not zero. Index: product · room + point, products beyond the grid's included.
template <typename Table, typename Activation, int C>
struct GridConcatForwardProgram {
  GridLevels grid;
  const Table* table;
  const float* points;      // [n, 3]
  const int64_t* n_points;  // on the device
  int64_t room;
  Activation* features;
  int64_t feature_row;  // a multiple of C

  NRFF_HOST_DEVICE int64_t size() const { return room * (feature_row / C); }
  NRFF_HOST_DEVICE void operator()(int64_t i) const {
    const int64_t product = i / room, point = i % room;
    Activation* to = features + point * feature_row + product * C;
    if (product >= 3 * grid.n_levels || point >= *n_points) {
      for (int c = 0; c < C; ++c) FromFloat(0, to[c]);
      return;
    }
    const GridProductAt<Table, C> at(grid.levels[product / 3], static_cast<int>(product % 3), table,
                                     points + 3 * point);
    for (int c = 0; c < C; ++c) FromFloat(at.plane_value[c] * at.line_value[c], to[c]);
  }
};

template <typename Table, typename Activation, int C>
struct GridConcatBackwardProgram {
  GridLevels grid;
  const Table* table;
  const float* points;
  const int64_t* n_points;
  int64_t room;
  const Activation* d_features;
  int64_t feature_row;
  float* gradient;  // accumulates

  NRFF_HOST_DEVICE int64_t size() const { return room * 3 * grid.n_levels; }
  NRFF_HOST_DEVICE void operator()(int64_t i) const {
    const int64_t product = i / room, point = i % room;
    if (point >= *n_points) return;
    float d_value[C];
    bool any = false;
    for (int c = 0; c < C; ++c) {
      d_value[c] = ToFloat(d_features[point * feature_row + product * C + c]);
      any = any || d_value[c] != 0;
    }
    if (!any) return;
    const GridProductAt<Table, C> at(grid.levels[product / 3], static_cast<int>(product % 3), table,
                                     points + 3 * point);
    at.Scatter(d_value, gradient);
  }
};

// σ = scale · softplus(f + shift) of the density grid.
template <typename Table, int C>
struct DensityForwardProgram {
  GridLevels grid;
  const Table* table;
  const float* points;
  const int64_t* n_points;
  int64_t room;
  float scale, shift;
  float* sigma;

  NRFF_HOST_DEVICE int64_t size() const { return room; }
  NRFF_HOST_DEVICE void operator()(int64_t i) const {
    if (i >= *n_points) return;
    float feature = 0;
    for (int l = 0; l < grid.n_levels; ++l) {
      for (int p = 0; p < 3; ++p) {
        const GridProductAt<Table, C> at(grid.levels[l], p, table, points + 3 * i);
        for (int c = 0; c < C; ++c) feature += at.plane_value[c] * at.line_value[c];
      }
    }
    float softplus, unused;
    FastSoftplus(feature + shift, softplus, unused);
    sigma[i] = scale * softplus;
  }
};

// dL/dσ → the density grid's gradient. Index: product · room + point.
template <typename Table, int C>
struct DensityBackwardProgram {
  GridLevels grid;
  const Table* table;
  const float* points;
  const int64_t* n_points;
  int64_t room;
  float scale;
  const float *sigma, *d_sigma;
  float* gradient;  // accumulates

  NRFF_HOST_DEVICE int64_t size() const { return room * 3 * grid.n_levels; }
  NRFF_HOST_DEVICE void operator()(int64_t i) const {
    const int64_t product = i / room, point = i % room;
    if (point >= *n_points || d_sigma[point] == 0) return;
    const float d_feature = d_sigma[point] * scale * -std::expm1(-sigma[point] / scale);
    float d_value[C];
    for (int c = 0; c < C; ++c) d_value[c] = d_feature;
    const GridProductAt<Table, C> at(grid.levels[product / 3], static_cast<int>(product % 3), table,
                                     points + 3 * point);
    at.Scatter(d_value, gradient);
  }
};

}  // namespace nrff::device
