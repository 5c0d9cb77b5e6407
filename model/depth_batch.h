// Batches of rays through sparse points, with the distances at which they should end.
#pragma once

#include <torch/types.h>

#include <cstdint>
#include <vector>

#include "pipeline/scene.h"
#include "render/kernels/depth_ray.h"
#include "render/volume_renderer.h"

namespace nrff {

class DepthSource {
 public:
  DepthSource(const Scene& scene, const std::vector<SparseDepth>& depths);

  bool empty() const { return targets_.empty(); }
  const std::vector<DepthTarget>& targets() const { return targets_; }

  struct Batch {
    Rays rays;               // from the camera through the point
    torch::Tensor distance;  // [n] of the point from the camera, scene units
    torch::Tensor spread;    // [n] its standard deviation and the marching step there, added in quadrature
  };
  // n depths, uniform over all, from the stream (seed, kDepthBatch at step); `march_step`: RenderOptions::step.
  Batch Draw(int64_t n, uint64_t seed, uint64_t step, const SceneMap& map, double march_step) const;

 private:
  std::vector<DepthTarget> targets_;
};

}  // namespace nrff
