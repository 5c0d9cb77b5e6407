// What training steps are tested on, whoever makes them.
#pragma once

#include <ostream>

#include "model/training_step.h"

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
