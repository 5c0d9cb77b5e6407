#include "model/train_state.h"

#include <ATen/ATen.h>

namespace nrff {

TrainState::TrainState(const FieldConfig& field_config, int occupancy_resolution, const SceneMap& scene_map,
                       uint64_t seed)
    : field(field_config, torch::kFloat, seed), occupancy(occupancy_resolution), map(scene_map) {
  for (const NrffField::Parameter& parameter : field.parameters()) {
    adam_m.push_back(at::zeros(parameter.value.sizes(), torch::kFloat));
    adam_v.push_back(at::zeros(parameter.value.sizes(), torch::kFloat));
  }
}

void TrainState::ResetAdam() {
  for (torch::Tensor& m : adam_m) m.zero_();
  for (torch::Tensor& v : adam_v) v.zero_();
  adam_t = 0;
}

void TrainState::AddToAverage() {
  const c10::NoGradGuard no_grad;
  ++n_averaged;
  if (average.empty()) {
    for (const NrffField::Parameter& parameter : field.parameters()) average.push_back(parameter.value.clone());
    return;
  }
  for (size_t i = 0; i < average.size(); ++i) {
    average[i].lerp_(field.parameters()[i].value, 1.0 / double(n_averaged));
  }
}

void TrainState::SwapAverage() {
  const c10::NoGradGuard no_grad;
  for (size_t i = 0; i < average.size(); ++i) {
    torch::Tensor value = field.parameters()[i].value;  // its memory is what the training step knows
    const torch::Tensor present = value.clone();
    value.copy_(average[i]);
    average[i].copy_(present);
  }
}

}  // namespace nrff
