// Volume rendering of packed rays: march, density, weights, shading of what matters, compositing.
//
//   τ_i = σ_i δ_i,  α_i = −expm1(−τ_i),  T_i = exp(−Σ_{j<i} τ_j),  w_i = T_i α_i          [Han23] Eq. 1
//   C = Σ w_i c_i + T_end · background
#pragma once

#include <torch/types.h>

#include <cstdint>
#include <optional>

#include "render/occupancy_grid.h"
#include "render/radiance_field.h"
#include "render/scene_map.h"

namespace nrff {

struct Rays {
  torch::Tensor origins;     // [n, 3] scene units
  torch::Tensor directions;  // [n, 3] unit
};

struct RenderOptions {
  float step = 0.01f;               // marching step, in Samples::delta's length (scene units; contracted units if unbounded)
  float near = 0.05f, far = 6.f;    // scene units
  float weight_threshold = 1e-4f;   // samples with w ≤ this are not shaded: colour error ≤ Σ of the weights left out
  float stop_transmittance = 1e-4f; // marching of weights stops when T falls below; exact for the set w > threshold when ≤ it
  float background = 1.f;           // grey level behind everything
  // Jitter of the first sample of every ray, from the counter-based stream (seed, counter); none when not given.
  std::optional<std::pair<uint64_t, uint64_t>> jitter;
};

struct RenderResult {
  torch::Tensor rgb;      // [n, 3] composited on the background
  torch::Tensor depth;    // [n] Σ w t, scene units along the ray (not differentiable)
  torch::Tensor normal;   // [n, 3] Σ w n
  torch::Tensor opacity;  // [n] 1 − T_end
  // Per sample, for losses:
  torch::Tensor sigma;           // [m] all marched samples
  torch::Tensor delta;           // [m]
  torch::Tensor shaded_weights;  // [k] weights of the shaded samples
  torch::Tensor shaded_normals;  // [k, 3]
  torch::Tensor shaded_directions;  // [k, 3] of their rays
  int64_t n_samples = 0;         // m: density evaluations
  int64_t n_shaded = 0;          // k: shading evaluations
};

// Differentiable (autograd) unless gradients are off. Rays that meet nothing return the background.
RenderResult RenderRays(const RadianceField& field, const OccupancyGrid& occupancy, const SceneMap& map,
                        const Rays& rays, const RenderOptions& options);

}  // namespace nrff
