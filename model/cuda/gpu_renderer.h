// Whole images of a model, made on a GPU.
#pragma once

#include <memory>

#include "model/cuda/gpu_factory.h"
#include "model/nrff_field.h"
#include "render/image_renderer.h"

namespace nrff {

class GpuRenderer {
 public:
  // Throws ResourceError when there is no room for the model.
  GpuRenderer(const GpuTrainerFactory& factory, const NrffField& field, const OccupancyGrid& occupancy);

  // RenderImage; without the spans of its colour tolerance, so every sample that is not left out is shaded by itself.
  RenderedImage Render(const View& view, const SceneMap& map, const RenderOptions& options) const;

 private:
  std::unique_ptr<GpuTrainer> gpu_;
};

}  // namespace nrff
