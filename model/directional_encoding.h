// The encodings that NRFF is compared with, in differentiable tensor operations (kernels/directional_encoding.h has
// their formulae): what the training step's hand-written kernels are held against. float or double.
#pragma once

#include <torch/types.h>

namespace nrff {

// directions [n, 3] reflected, unit; raw roughness [n, 1] → [n, kIdeFeatures]
torch::Tensor IdeEncode(const torch::Tensor& directions, const torch::Tensor& raw);

// ray_directions [n, 3] → [n, kPeFeatures]
torch::Tensor PeEncode(const torch::Tensor& ray_directions);

}  // namespace nrff
