// The NRFF model [Han23]: multiscale tensor decomposition for density and appearance, a spatial network, rendering
// equation encoding, a directional network.
//
//   σ    = density_scale · softplus(f_σ(x) + density_shift)
//   spatial network:      f_a(x) → diffuse (3), tint (3), normal (3), bottleneck, lobe features
//   n    = −normalised(normal),  ω = 2 (wo·n) n − wo,  wo = −ray_direction
//   encoding              = ReeEncode(ω; a, λ, μ from one linear layer shared by the rows of lobes)
//   directional network:  (bottleneck, encoding, n·wo) → s (3)
//   rgb  = sigmoid(diffuse + tint ⊙ s)
//
// FieldConfig::directional_encoding puts another encoding there (kernels/directional_encoding.h), and decoded_features
// a linear layer before the spatial network.
//
// Deviations from the paper follow the authors' code, and are where FieldConfig says so.
#pragma once

#include <torch/types.h>

#include <array>
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "model/config.h"
#include "model/kernel_functions.h"
#include "model/kernels/shading_tile.h"
#include "render/radiance_field.h"

namespace nrff {

class NrffField : public RadianceField {
 public:
  // Fresh parameters from the stream (seed, RandomStream::kInitialisation). `type`: torch::kFloat or torch::kDouble.
  NrffField(const FieldConfig& config, torch::Dtype type, uint64_t seed);

  // Points of another type are converted.
  torch::Tensor Density(const torch::Tensor& points) const override;
  Shading Shade(const torch::Tensor& points, const torch::Tensor& ray_directions) const override;

  // By the kernels, which take float parameters alone.
  void DensityOf(const float* points, int64_t n, float* sigma) const override;
  std::unique_ptr<Shader> MakeShader(ShadingPrecision precision) const override;
  std::unique_ptr<RadianceField> WithoutFinestLevels(int n) const override;
  // Views of the parameters, for the kernels; valid as long as the field.
  ShadingNetworks Networks() const;
  const float* density_parameters() const { return density_grid_.const_data_ptr<float>(); }
  const float* appearance_parameters() const { return appearance_grid_.const_data_ptr<float>(); }

  // [corrected_views, 12]; undefined where there are none.
  const torch::Tensor& colour_corrections() const { return colour_corrections_; }

  // The stages of Density and Shade.
  torch::Tensor DensityFeature(const torch::Tensor& points) const;       // [n]
  torch::Tensor DensityFromFeature(const torch::Tensor& feature) const;  // [n] sigma
  torch::Tensor AppearanceFeature(const torch::Tensor& points) const;    // [n, 3 · levels · channels]
  struct ShadingParts {
    torch::Tensor diffuse, tint, normal;  // [n, 3]; without a directional network, normal is zero
    torch::Tensor bottleneck;             // [n, bottleneck_width]
    torch::Tensor encoding_share;         // [n, lobes_theta · lobe_row_width] features of lobes; IDE: [n, 1]
    torch::Tensor reflected_direction;    // [n, 3]
    torch::Tensor lobe_parameters;        // [n, lobes · kLobeParameters]; of REE alone
    torch::Tensor encoding;               // [n, lobes · kLobeAmplitudes], or that of the other encodings
    torch::Tensor rgb;                    // [n, 3]
  };
  ShadingParts ShadeFeature(const torch::Tensor& appearance_feature, const torch::Tensor& ray_directions) const;

  // mean |parameter| of each plane and line of the density grid, averaged over them.
  torch::Tensor DensityL1() const;

  struct Parameter {
    std::string name;     // "density_grid", "appearance_grid", "spatial_mlp.0.weight", …, "colour_corrections"
    torch::Tensor value;  // a leaf that requires gradients
    bool is_grid = false;
  };
  // In a fixed order.
  const std::vector<Parameter>& parameters() const { return parameters_; }
  int64_t n_parameters() const;
  const FieldConfig& config() const { return config_; }
  torch::Dtype type() const { return type_; }
  const GridLayout& density_layout() const { return density_layout_->layout; }
  const GridLayout& appearance_layout() const { return appearance_layout_->layout; }

  // Makes [min, max] of the present field coordinates the new [-1, 1]³: grids are resampled at their new nodes.
  void Crop(const std::array<double, 3>& min, const std::array<double, 3>& max);

 private:
  struct Linear {
    torch::Tensor weight, bias;  // [out, in], [out]
    torch::Tensor operator()(const torch::Tensor& x) const;
  };
  using Mlp = std::vector<Linear>;

  torch::Tensor AddParameter(const std::string& name, const std::vector<int64_t>& shape, bool is_grid);
  Linear MakeLinear(const std::string& name, int n_in, int n_out);
  Mlp MakeMlp(const std::string& name, int n_in, int width, int n_layers, int n_out);
  // The layers before `first_activated` are followed by no activation.
  torch::Tensor Apply(const Mlp& mlp, torch::Tensor x, size_t first_activated = 0) const;
  void Initialise(uint64_t seed);

  FieldConfig config_;
  torch::Dtype type_;
  GridLayoutPtr density_layout_, appearance_layout_;
  LobesPtr lobes_;
  std::vector<Parameter> parameters_;
  torch::Tensor density_grid_, appearance_grid_, colour_corrections_;
  torch::Tensor density_l1_weights_;  // of |density_grid_|, summing to 1
  Mlp spatial_, directional_;         // spatial_ begins with the decoder, where there is one
  Linear lobe_layer_;
};

}  // namespace nrff
