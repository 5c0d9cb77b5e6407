// The kernels as differentiable functions of tensors: the one place that knows both.
//
// Tensors are float or double, all of one type, on the CPU.
#pragma once

#include <ATen/core/ivalue.h>
#include <torch/types.h>

#include "model/kernels/feature_grid.h"
#include "model/kernels/ree.h"

namespace nrff {

// Sizes that outlive the graph they are used in.
struct SharedGridLayout : torch::CustomClassHolder {
  explicit SharedGridLayout(GridLayout l) : layout(std::move(l)) {}
  GridLayout layout;
};
struct SharedLobes : torch::CustomClassHolder {
  explicit SharedLobes(Lobes l) : lobes(std::move(l)) {}
  Lobes lobes;
};
using GridLayoutPtr = c10::intrusive_ptr<SharedGridLayout>;
using LobesPtr = c10::intrusive_ptr<SharedLobes>;

// parameters [n_parameters], points [n, 3] → [n, n_features]. Differentiable in the parameters only.
torch::Tensor GridConcat(const GridLayoutPtr& layout, const torch::Tensor& parameters, const torch::Tensor& points);
// → [n]
torch::Tensor GridSum(const GridLayoutPtr& layout, const torch::Tensor& parameters, const torch::Tensor& points);

// directions [n, 3] unit, raw [n, lobes · kLobeParameters] → [n, lobes · kLobeAmplitudes]
torch::Tensor ReeEncode(const LobesPtr& lobes, const torch::Tensor& directions, const torch::Tensor& raw);

}  // namespace nrff
