// What training steps are tested on, whoever makes them.
#pragma once

#include <c10/core/GradMode.h>

#include <ostream>
#include <vector>

#include "model/training_step.h"
#include "render/kernels/random.h"

namespace nrff {

struct StepCase {
  const char* name;
  bool unbounded;
  Activation activation;
  LossWeights weights;
  double stop = 1e-4, threshold = 1e-4;
  int n_depths = 0;
  void (*change)(FieldConfig&) = [](FieldConfig&) {};
};

inline void PrintTo(const StepCase& c, std::ostream* out) { *out << c.name; }

// A case of the paper's losses with another field.
inline StepCase With(const char* name, void (*change)(FieldConfig&)) {
  StepCase c{name, false, Activation::kGelu, {.orientation = 0.3, .density_l1 = 8e-5}};
  c.change = change;
  return c;
}

inline constexpr int kCorrectedViews = 6;
inline StepCase ColourCorrections() {
  StepCase c = With("ColourCorrections", [](FieldConfig& f) { f.corrected_views = kCorrectedViews; });
  c.weights.correction = 0.02;
  return c;
}

// Views with colours of their own, which start at none: corrections that make a difference, the same for every field.
inline void SetCorrections(const NrffField& field) {
  if (field.config().corrected_views == 0) return;
  const c10::NoGradGuard no_grad;
  const torch::Tensor& corrections = field.colour_corrections();
  for (int64_t i = 0; i < corrections.numel(); ++i) {
    corrections.view({-1})[i] = 0.3 * (Uniform(5, 1, uint64_t(i)) - 0.5F);
  }
}

// What both sides of a step have.
inline std::vector<StepCase> CommonStepCases() {
  return {{"ColourAlone", false, Activation::kRelu, {}},
          {"Paper", false, Activation::kGelu, {.orientation = 0.3, .density_l1 = 8e-5}},
          {"Sparsity", false, Activation::kRelu, {.sparsity = 0.1}},
          {"StopsEarly", false, Activation::kRelu, {.orientation = 0.3}, 0.02, 0.02},
          {"UnboundedWithDepths",
           true,
           Activation::kRelu,
           {.orientation = 0.3, .sparsity = 1e-3, .depth = 0.1},
           0.01,
           0.01,
           100},
          With("DiffuseAlone", [](FieldConfig& f) { f.directional_encoding = DirectionalEncoding::kNone; }),
          With("VectorMatrixDecoded",
               [](FieldConfig& f) {
                 f.levels = 1;
                 f.base_resolution = f.max_resolution;
                 f.density_channels = 8;
                 f.appearance_channels = 12;
                 f.decoded_features = 7;
               }),
          ColourCorrections()};
}

// Sizes that divide nothing.
inline FieldConfig SmallField(const StepCase& c) {
  FieldConfig config;
  config.levels = 3;
  config.base_resolution = 6;
  config.max_resolution = 20;
  config.appearance_line_mean = 1;
  config.density_shift = -1;
  config.density_scale = c.unbounded ? 12 : 6;
  config.spatial_width = 24;
  config.spatial_layers = 3;
  config.bottleneck_width = 10;
  config.lobes_theta = 3;
  config.lobes_phi = 5;
  config.lobe_row_width = 7;
  config.directional_layers = 3;
  config.directional_width = 20;
  config.activation = c.activation;
  c.change(config);
  return config;
}

}  // namespace nrff
