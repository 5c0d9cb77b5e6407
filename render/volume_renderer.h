// Volume rendering of packed rays: march, density, weights, shading of what matters, compositing.
//
//   τ_i = σ_i δ_i,  α_i = −expm1(−τ_i),  T_i = exp(−Σ_{j<i} τ_j),  w_i = T_i α_i          [Han23] Eq. 1
//   C = Σ w_i c_i + T_end · background
//
// Tensors are float or double, all of one type: the type of the rays.
#pragma once

#include <torch/types.h>

#include <cstdint>
#include <optional>
#include <utility>
#include <vector>

#include "pipeline/scene.h"
#include "render/kernels/random.h"
#include "render/occupancy_grid.h"
#include "render/radiance_field.h"
#include "render/scene_map.h"

namespace nrff {

struct Rays {
  torch::Tensor origins;     // [n, 3] scene units
  torch::Tensor directions;  // [n, 3] unit
};

// pixels [n, 3] int32: (index into `views`, ix, iy) → rays through the pixels' centres; `type`: torch::kFloat or
// torch::kDouble.
Rays RaysThroughPixels(const std::vector<View>& views, const torch::Tensor& pixels, torch::Dtype type);

struct RenderOptions {
  double step = 0.01;              // marching step = delta of every sample: scene units; contracted units if unbounded
  double near = 0.05, far = 6;     // scene units along the ray
  double weight_threshold = 1e-4;  // samples with w ≤ this are not shaded: colour error ≤ Σ of the weights left out
  // RenderImage alone: about how far a pixel's colour may be off to save shading; 0: every sample above the threshold
  // is shaded. Of these, those of least weight are left out as long as their weights sum to at most this: they take the
  // mean colour of the others. The rest is shaded in pairs and spans (ray_quadrature.h), whose error is estimated, not
  // bounded. Rays end where half of this is left of the light.
  double colour_tolerance = 0;
  ShadingPrecision precision = ShadingPrecision::kFloat;  // RenderImage alone
  double stop_transmittance = 1e-4;  // a ray ends when T falls below; exact for the set w > threshold when ≤ it
  double background = 1;             // grey level behind everything
  // Jitter of the first sample of every ray, from the stream (seed, jitter_purpose at counter); none when not given.
  std::optional<std::pair<uint64_t, uint64_t>> jitter;
  RandomStream jitter_purpose = RandomStream::kRayJitter;
};

struct RenderResult {
  torch::Tensor rgb;      // [n, 3] composited on the background
  torch::Tensor depth;    // [n] Σ w t, scene units along the ray (not differentiable)
  torch::Tensor normal;   // [n, 3] Σ w n over the shaded samples
  torch::Tensor opacity;  // [n] 1 − T_end
  // Per sample, for losses:
  torch::Tensor sigma;              // [m] all marched samples
  torch::Tensor delta;              // [m]
  torch::Tensor weights;            // [m]
  torch::Tensor shaded_weights;     // [k] weights of the shaded samples
  torch::Tensor shaded_normals;     // [k, 3]
  torch::Tensor shaded_directions;  // [k, 3] of their rays
  int64_t n_samples = 0;            // m: density evaluations
  int64_t n_shaded = 0;             // k: shading evaluations
};

// Packed samples: those of ray r are ray_offsets[r] … ray_offsets[r + 1] − 1, front to back.
struct Samples {
  torch::Tensor ray_offsets;  // [n_rays + 1] int64
  torch::Tensor ray_index;    // [m] int64
  torch::Tensor t, delta;     // [m] along the ray in scene units; the length that density is integrated over
  torch::Tensor points;       // [m, 3] field coordinates
};

// The marched samples in occupied cells (render/kernels/sampling.h). Throws as RenderRays.
Samples MarchRays(const OccupancyGrid& occupancy, const SceneMap& map, const Rays& rays, const RenderOptions& options);

// Throws InputError on a step, near or far that cannot be marched.
void CheckOptions(const RenderOptions& options);

// How light gets along the rays, without colour.
struct Visibility {
  torch::Tensor sigma;          // [m]
  torch::Tensor weights;        // [m]
  torch::Tensor transmittance;  // [n_rays] behind the last sample
};
Visibility MeasureVisibility(const RadianceField& field, const Samples& samples, double stop_transmittance);

// What RenderRays does with the samples it marched.
RenderResult RenderSamples(const RadianceField& field, const Samples& samples, const Rays& rays,
                           const RenderOptions& options);

// Differentiable (autograd) unless gradients are off. Rays that meet nothing return the background. The field is not
// called with zero points. Throws InputError on a step, near or far that cannot be marched.
RenderResult RenderRays(const RadianceField& field, const OccupancyGrid& occupancy, const SceneMap& map,
                        const Rays& rays, const RenderOptions& options);

}  // namespace nrff
