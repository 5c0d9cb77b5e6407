// Grids over a part of what they covered.
#pragma once

#include <torch/types.h>

#include <array>

#include "model/kernels/feature_grid.h"

namespace nrff {

// parameters [layout.n_parameters] over [-1, 1]³ → parameters of the same layout whose [-1, 1]³ is [min, max] of it:
// every plane and line interpolated linearly at its new nodes.
torch::Tensor CropGrid(const GridLayout& layout, const torch::Tensor& parameters, const std::array<double, 3>& min,
                       const std::array<double, 3>& max);

}  // namespace nrff
