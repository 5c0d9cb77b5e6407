// The NRFF model as the authors' code computes it, in plain libtorch operations with autograd, in double: independent
// of the kernels and of NrffField. Parameters go by their names in the authors' code.
#pragma once

#include <torch/types.h>

#include <map>
#include <string>

namespace nrff::testing {

struct OracleSettings {
  int levels = 0;
  int lobes_theta = 0;
  double density_shift = -10, distance_scale = 25, weight_threshold = 1e-4, background = 1;
};

class Oracle {
 public:
  // "density_field.tensors.0.plane_xy" … "rendering_net.directional_mlp.10.bias"; leaves that require gradients.
  Oracle(std::map<std::string, torch::Tensor> parameters, OracleSettings settings);

  // points [n, 3] in [-1, 1]
  torch::Tensor DensityFeature(const torch::Tensor& points) const;     // [n]
  torch::Tensor Density(const torch::Tensor& feature) const;           // softplus(f + shift), without the scale
  torch::Tensor AppearanceFeature(const torch::Tensor& points) const;  // [n, levels · 3 · channels]

  struct Shading {
    torch::Tensor diffuse, tint, normal, bottleneck, asg_feature, asg_a, asg_lambda_raw, asg_mu_raw;
    torch::Tensor reflected_direction, encoding, rgb;
    torch::Tensor lobe_axis, lobe_axis_lambda, lobe_axis_mu;  // [n_theta, n_phi, 3]
  };
  Shading Shade(const torch::Tensor& appearance_feature, const torch::Tensor& view_direction) const;

  struct Rendering {
    torch::Tensor density, weight;    // [n_rays, n_samples]
    torch::Tensor background_weight;  // [n_rays, 1]
    torch::Tensor rgb, depth;         // [n_rays, 3], [n_rays]
    torch::Tensor orientation_loss;   // scalar
  };
  // rays [n, 6]: origin, direction; t [n, n_samples] with inside [n, n_samples] bool; aabb [2, 3].
  Rendering Render(const torch::Tensor& rays, const torch::Tensor& t, const torch::Tensor& inside,
                   const torch::Tensor& aabb) const;

  // Mean over the density grid's planes and lines of mean |parameter|.
  torch::Tensor DensityL1() const;

  const std::map<std::string, torch::Tensor>& parameters() const { return parameters_; }

 private:
  torch::Tensor At(const std::string& name) const;
  // [3, channels, n] of one level
  torch::Tensor Products(const std::string& field, int level, const torch::Tensor& points) const;
  torch::Tensor Mlp(const std::string& name, torch::Tensor x) const;

  std::map<std::string, torch::Tensor> parameters_;
  OracleSettings settings_;
};

}  // namespace nrff::testing
