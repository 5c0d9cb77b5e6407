// A field as a GPU sees it, and its parameters to and from the GPU's one array.
#pragma once

#include <vector>

#include "model/cuda/gpu_trainer.h"
#include "model/nrff_field.h"

namespace nrff {

// Throws std::invalid_argument for directional encodings that a GPU has not.
GpuModel MakeGpuModel(const NrffField& field);

// tensors: as field.parameters(), float. `flat` [model.n_parameters]; zeros between the segments.
std::vector<float> Flatten(const GpuModel& model, const std::vector<torch::Tensor>& tensors);
void Unflatten(const GpuModel& model, const std::vector<float>& flat, const std::vector<torch::Tensor>& tensors);

}  // namespace nrff
