// A field as a GPU sees it, and its parameters to and from the GPU's one array.
#pragma once

#include <exception>
#include <string>
#include <vector>

#include "model/cuda/gpu_trainer.h"
#include "model/depth_batch.h"
#include "model/nrff_field.h"
#include "model/ray_batch.h"
#include "pipeline/error.h"
#include "render/volume_renderer.h"

namespace nrff {

// Throws InputError for directional encodings that a GPU has not.
GpuModel MakeGpuModel(const NrffField& field);

// What work() returns. What the GPU or its driver reports becomes a ResourceError.
template <typename Work>
auto OnGpu(const Work& work) {
  try {
    return work();
  } catch (const std::exception& error) {
    throw ResourceError("the GPU failed: " + std::string(error.what()) + "; run it again, or with --device cpu");
  }
}

// Points into the sources' memory.
std::vector<device::GpuView> MakeGpuViews(const PixelSource& pixels);
GpuScene MakeGpuScene(const PixelSource& pixels, const DepthSource& depths);

// The field's parameters, in their order, without gradients.
std::vector<torch::Tensor> ValuesOf(const NrffField& field);

// What of a step's control follows from the scene and the options.
device::StepControl MakeControl(const SceneMap& map, const RenderOptions& options);

// tensors: as field.parameters(), float. `flat` [model.n_parameters]; zeros between the segments.
std::vector<float> Flatten(const GpuModel& model, const std::vector<torch::Tensor>& tensors);
void Unflatten(const GpuModel& model, const std::vector<float>& flat, const std::vector<torch::Tensor>& tensors);

}  // namespace nrff
