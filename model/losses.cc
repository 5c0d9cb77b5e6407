#include "model/losses.h"

#include <ATen/ATen.h>

namespace nrff {

using torch::Tensor;

Tensor MseLoss(const Tensor& rgb, const Tensor& target) { return at::mse_loss(rgb, target); }

Tensor OrientationLoss(const Tensor& weights, const Tensor& normals, const Tensor& ray_directions) {
  if (weights.numel() == 0) return at::zeros({}, weights.options());
  return (weights * (normals * ray_directions).sum(1).clamp_min(0).square()).mean();
}

Tensor SparsityLoss(const Tensor& sigma, const Tensor& delta, int64_t n_rays) {
  return -at::expm1(-sigma * delta).sum() / double(n_rays);
}

Tensor DepthLoss(const Tensor& weights, const Tensor& t, const Tensor& ray_index, const Tensor& distance,
                 const Tensor& spread) {
  const Tensor off = (t - distance.index_select(0, ray_index)) / spread.index_select(0, ray_index);
  return 1 - (weights * at::exp(-0.5 * off.square())).sum() / double(distance.numel());
}

Tensor CorrectionLoss(const Tensor& corrections) { return corrections.square().sum() / double(corrections.size(0)); }

}  // namespace nrff
