// What training minimises besides density L1 (NrffField::DensityL1). Scalars, differentiable.
#pragma once

#include <torch/types.h>

namespace nrff {

// Mean squared difference of colours: rgb, target [n, 3].
torch::Tensor MseLoss(const torch::Tensor& rgb, const torch::Tensor& target);

// Normals of visible samples should face the camera [Verbin22] Eq. 11: mean over samples of w · max(n·d, 0)².
// weights [k], normals and ray_directions [k, 3]; 0 for k = 0.
torch::Tensor OrientationLoss(const torch::Tensor& weights, const torch::Tensor& normals,
                              const torch::Tensor& ray_directions);

// Space is mostly empty: Σ over samples of 1 − exp(−σ δ), per ray. sigma, delta [m].
torch::Tensor SparsityLoss(const torch::Tensor& sigma, const torch::Tensor& delta, int64_t n_rays);

// Light should end where SfM saw a surface [Deng22]: mean over rays of 1 − Σ w exp(−½ ((t − distance)/spread)²), which
// is in [0, 1], so that a wrong point pulls no harder than a right one. weights, t [m]; ray_index [m] int64;
// distance, spread [n_rays], in the unit of t.
torch::Tensor DepthLoss(const torch::Tensor& weights, const torch::Tensor& t, const torch::Tensor& ray_index,
                        const torch::Tensor& distance, const torch::Tensor& spread);

// Views should show the scene's own colours as far as they can, which also says what these are: mean over views of the
// squared corrections [n_views, 12].
torch::Tensor CorrectionLoss(const torch::Tensor& corrections);

}  // namespace nrff
