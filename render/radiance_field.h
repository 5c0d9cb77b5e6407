// The renderer's view of a model: density anywhere, colour and normal where asked. Anything that can say these can be
// rendered.
#pragma once

#include <torch/types.h>

#include <cstdint>
#include <memory>

namespace nrff {

// Of the operands of the networks' products.
enum class ShadingPrecision { kFloat, kBf16 };

// Field coordinates: the scene map (scene_map.h) takes scene points to [-1, 1]³.
class DensitySource {
 public:
  virtual ~DensitySource() = default;

  // points [n, 3] in field coordinates → extinction coefficient sigma [n] ≥ 0, per unit of the length that sample
  // intervals are measured in (Samples::delta). In float and without gradients; any number of threads at once.
  virtual void DensityOf(const float* points, int64_t n, float* sigma) const = 0;
  // How many points a caller with many should give at once.
  virtual int64_t points_at_once() const { return 1024; }
};

class RadianceField : public DensitySource {
 public:
  // DensityOf for tensors, points [n, 3] → sigma [n], differentiable with respect to the field's parameters.
  virtual torch::Tensor Density(const torch::Tensor& points) const = 0;

  struct Shading {
    torch::Tensor rgb;     // [n, 3] in [0, 1], display-referred
    torch::Tensor normal;  // [n, 3] unit, scene axes, outward
  };
  // points as above; ray_directions [n, 3] unit, leaving the camera.
  virtual Shading Shade(const torch::Tensor& points, const torch::Tensor& ray_directions) const = 0;

  // By default by way of Density, as MakeShader is by way of Shade: for one thread of a renderer.
  void DensityOf(const float* points, int64_t n, float* sigma) const override;
  class Shader {
   public:
    virtual ~Shader() = default;
    // Samples begin … end − 1 seen as one: what they have in common is averaged by their weights, then shaded once.
    struct Span {
      int64_t begin, end;
    };
    // The samples of the spans to come: points [n, 3], weights [n] > 0.
    virtual void SetSamples(const float* points, const float* weights, int64_t n) = 0;
    // spans [n], ray_directions [n, 3] → rgb, normals [n, 3]. A span of one sample shows its colour.
    virtual void Shade(const Span* spans, const float* ray_directions, int64_t n, float* rgb, float* normals) = 0;
  };
  // For the use of one thread; the field must outlive it. A field may be more precise than asked for.
  virtual std::unique_ptr<Shader> MakeShader(ShadingPrecision precision) const;

  // A copy that lacks the n finest levels of its grids and is cheaper for it, n ≥ 0; null where it has no such levels.
  virtual std::unique_ptr<RadianceField> WithoutFinestLevels(int n) const;
};

}  // namespace nrff
