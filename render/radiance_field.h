// The renderer's view of a model: density anywhere, colour and normal where asked. Anything that can say these can be
// rendered and trained.
#pragma once

#include <torch/types.h>

namespace nrff {

// Field coordinates: the scene map (scene_map.h) takes scene points to [-1, 1]³.
class RadianceField {
 public:
  virtual ~RadianceField() = default;

  // points [n, 3] in field coordinates → extinction coefficient sigma [n] ≥ 0, per unit of the length that sample
  // intervals are measured in (Samples::delta). Differentiable with respect to the field's parameters.
  virtual torch::Tensor Density(const torch::Tensor& points) const = 0;

  struct Shading {
    torch::Tensor rgb;     // [n, 3] in [0, 1], display-referred
    torch::Tensor normal;  // [n, 3] unit, scene axes, outward
  };
  // points as above; ray_directions [n, 3] unit, leaving the camera.
  virtual Shading Shade(const torch::Tensor& points, const torch::Tensor& ray_directions) const = 0;
};

}  // namespace nrff
