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

}  // namespace nrff
