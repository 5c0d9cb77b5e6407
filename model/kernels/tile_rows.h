// Between the layouts of packed samples and the rows of a tile (shading_tile.h), and the density's activation.
#pragma once

#include <cstdint>

#include "model/kernels/feature_grid.h"

namespace nrff {

// features [n_products][n][C] → rows 3·C·level + C·product + channel; up to the next multiple of
// ShadingTile::kSamplesMultiple, zero.
void ProductsToRows(const float* features, const GridLayout& layout, int64_t n, int64_t stride, float* rows);
// The same for spans of samples, by their weighted means: samples begins[s] … ends[s] − 1 make column s.
struct SpanMeans {
  int64_t n_samples = 0;
  const float* features = nullptr;  // [n_products][n_samples][C]
  const float* weights = nullptr;   // [n_samples] > 0
  int64_t n_spans = 0;
  const int64_t *begins = nullptr, *ends = nullptr;  // [n_spans]; none is empty
};
void MeansToRows(const SpanMeans& args, const GridLayout& layout, int64_t stride, float* rows);
// The reverse of ProductsToRows, without the padding.
void RowsToProducts(const float* rows, const GridLayout& layout, int64_t n, int64_t stride, float* features);

// points [n, 3] → 3 rows, padded with zeros.
void PointsToRows(const float* points, int64_t n, int64_t stride, float* rows);
void RowsToPoints(const float* rows, int64_t n, int64_t stride, float* points);

// σ = scale · softplus(f + shift), in place.
void DensitiesFromFeatures(float scale, float shift, int64_t n, float* values);
// dL/df = dL/dσ · dσ/df with dσ/df = scale · (1 − exp(−σ/scale)), in place.
void DensityGradients(float scale, const float* sigma, int64_t n, float* d);

}  // namespace nrff
