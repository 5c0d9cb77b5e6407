// The oracle and the production field behind one face, so that the same tests run on both.
#pragma once

#include <torch/types.h>

#include <map>
#include <memory>
#include <string>

#include "model/safetensors.h"

namespace nrff::testing {

enum class ModelKind { kOracle, kFieldDouble, kFieldFloat };

struct ReferenceLosses {
  torch::Tensor mse, orientation, density_l1;
  torch::Tensor Total() const { return mse + 0.3 * orientation + 8e-5 * density_l1; }
};

struct RenderInput {
  torch::Tensor rays;    // [n_rays, 6]
  torch::Tensor t;       // [n_rays, n_samples]
  torch::Tensor inside;  // [n_rays, n_samples] bool
  torch::Tensor aabb;    // [2, 3]
  torch::Tensor target;  // [n_rays, 3]
  double weight_threshold, background;
};
RenderInput ReadRenderInput(const SafetensorsFile& file);

struct RenderedReference {
  torch::Tensor density, weight;    // [n_rays, n_samples]
  torch::Tensor background_weight;  // [n_rays]
  torch::Tensor rgb, depth;         // depth as the authors compute it
  ReferenceLosses losses;
};

class ReferenceModel {
 public:
  virtual ~ReferenceModel() = default;
  virtual torch::Tensor DensityFeature(const torch::Tensor& points) = 0;
  virtual torch::Tensor DensityOverScale(const torch::Tensor& feature) = 0;
  virtual torch::Tensor AppearanceFeature(const torch::Tensor& points) = 0;
  // By the file's names below shading/.
  virtual std::map<std::string, torch::Tensor> Shade(const torch::Tensor& appearance_feature,
                                                     const torch::Tensor& view_direction) = 0;
  virtual RenderedReference Render(const RenderInput& input) = 0;
  // By the authors' names; what backward() has left.
  virtual std::map<std::string, torch::Tensor> Gradients() = 0;
  // One step with the present gradients, which it clears. t ≥ 1.
  virtual void AdamStep(int t, double grid_rate, double network_rate) = 0;
};

std::unique_ptr<ReferenceModel> MakeReferenceModel(ModelKind kind, const SafetensorsFile& file);

}  // namespace nrff::testing
