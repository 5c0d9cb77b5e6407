#include <algorithm>

#include "model/kernels/fast_math.h"
#include "model/kernels/shading_tile.h"
#include "model/kernels/simd.h"
#include "model/kernels/tile_rows.h"

namespace nrff {
namespace {

void Pad(float* row, int64_t n) {
  constexpr int64_t kMultiple = ShadingTile::kSamplesMultiple;
  std::fill(row + n, row + (n + kMultiple - 1) / kMultiple * kMultiple, 0.F);
}

template <int C>
NRFF_INLINE void ToRows(const float* features, int64_t n, int64_t stride, float* rows) {
  for (int64_t s = 0; s < n; ++s) {
    for (int c = 0; c < C; ++c) rows[c * stride + s] = features[s * C + c];
  }
  for (int c = 0; c < C; ++c) Pad(rows + c * stride, n);
}

template <int C>
NRFF_INLINE void FromRows(const float* rows, int64_t n, int64_t stride, float* features) {
  for (int64_t s = 0; s < n; ++s) {
    for (int c = 0; c < C; ++c) features[s * C + c] = rows[c * stride + s];
  }
}

template <int C>
NRFF_INLINE void MeansToRowsOf(const SpanMeans& args, const float* features, int64_t stride, float* rows) {
  for (int64_t s = 0; s < args.n_spans; ++s) {
    const int64_t begin = args.begins[s], end = args.ends[s];
    float sum[C] = {}, weight = 0;
    for (int64_t i = begin; i < end; ++i) {
      weight += args.weights[i];
      for (int c = 0; c < C; ++c) sum[c] += args.weights[i] * features[i * C + c];
    }
    // One sample is its own mean, to the last bit.
    const float scale = 1 / weight;
    for (int c = 0; c < C; ++c) rows[c * stride + s] = end - begin == 1 ? features[begin * C + c] : scale * sum[c];
  }
  for (int c = 0; c < C; ++c) Pad(rows + c * stride, args.n_spans);
}

}  // namespace

NRFF_MULTIVERSION void MeansToRows(const SpanMeans& args, const GridLayout& layout, int64_t stride, float* rows) {
  for (int p = 0; p < layout.n_products(); ++p) {
    const int64_t n_before = p * layout.n_channels;
    const float* features = args.features + n_before * args.n_samples;
    if (layout.n_channels == 2) MeansToRowsOf<2>(args, features, stride, rows + n_before * stride);
    if (layout.n_channels == 4) MeansToRowsOf<4>(args, features, stride, rows + n_before * stride);
  }
}

NRFF_MULTIVERSION void ProductsToRows(const float* features, const GridLayout& layout, int64_t n, int64_t stride,
                                      float* rows) {
  for (int p = 0; p < layout.n_products(); ++p) {
    if (layout.n_channels == 2) ToRows<2>(features + p * n * 2, n, stride, rows + p * 2 * stride);
    if (layout.n_channels == 4) ToRows<4>(features + p * n * 4, n, stride, rows + p * 4 * stride);
  }
}

NRFF_MULTIVERSION void RowsToProducts(const float* rows, const GridLayout& layout, int64_t n, int64_t stride,
                                      float* features) {
  for (int p = 0; p < layout.n_products(); ++p) {
    if (layout.n_channels == 2) FromRows<2>(rows + p * 2 * stride, n, stride, features + p * n * 2);
    if (layout.n_channels == 4) FromRows<4>(rows + p * 4 * stride, n, stride, features + p * n * 4);
  }
}

NRFF_MULTIVERSION void PointsToRows(const float* points, int64_t n, int64_t stride, float* rows) {
  ToRows<3>(points, n, stride, rows);
}

NRFF_MULTIVERSION void RowsToPoints(const float* rows, int64_t n, int64_t stride, float* points) {
  FromRows<3>(rows, n, stride, points);
}

NRFF_MULTIVERSION void DensitiesFromFeatures(float scale, float shift, int64_t n, float* values) {
  for (int64_t i = 0; i < n; ++i) {
    float softplus, unused;
    FastSoftplus(values[i] + shift, softplus, unused);
    values[i] = scale * softplus;
  }
}

NRFF_MULTIVERSION void DensityGradients(float scale, const float* sigma, int64_t n, float* d) {
  const float inverse_scale = 1 / scale;
  for (int64_t i = 0; i < n; ++i) {
    // 1 − e^−y; for small y by its series, where the difference would lose its digits.
    const float y = sigma[i] * inverse_scale;
    const float series = y * (1 - y * (0.5F - y * (1.F / 6 - y * (1.F / 24))));
    const float difference = 1 - FastExp(-y);
    d[i] *= scale * (y < 0.1F ? series : difference);
  }
}

}  // namespace nrff
