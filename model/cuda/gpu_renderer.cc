#include "model/cuda/gpu_renderer.h"

#include <algorithm>
#include <exception>

#include "model/cuda/gpu_model.h"
#include "pipeline/error.h"

namespace nrff {
namespace {

constexpr GpuRoom kRoom{16384, 16384 * 96, 16384 * 16};  // worked on at once

}  // namespace

GpuRenderer::GpuRenderer(const GpuTrainerFactory& factory, const NrffField& field, const OccupancyGrid& occupancy) {
  const GpuModel model = MakeGpuModel(field);
  try {
    gpu_ = factory(model, {}, occupancy.resolution(), {.room = kRoom, .trains = false});
  } catch (const std::exception& error) {
    throw ResourceError(std::string(error.what()) + "; use --device cpu");
  }
  gpu_->SetParameters(Flatten(model, ValuesOf(field)).data());
  gpu_->SetOccupancy(occupancy.bits());
}

RenderedImage GpuRenderer::Render(const View& view, const SceneMap& map, const RenderOptions& options) const {
  CheckOptions(options);
  GpuRays rays;
  rays.n = int64_t{view.width} * view.height;
  rays.width = view.width;
  rays.camera = {view.fx, view.fy, view.cx, view.cy, {}};
  std::copy_n(view.scene_from_camera.begin(), 12, rays.camera.scene_from_camera);
  RenderedImage image;
  image.width = view.width;
  image.height = view.height;
  image.rgb.resize(3 * rays.n);
  image.depth.resize(rays.n);
  image.normal.resize(3 * rays.n);
  image.opacity.resize(rays.n);
  const auto evaluated = OnGpu([&] {
    return gpu_->Render(rays, MakeControl(map, options),
                        {image.rgb.data(), image.depth.data(), image.normal.data(), image.opacity.data()});
  });
  image.n_samples = evaluated[0];
  image.n_shaded = evaluated[1];
  NormaliseGeometry(image);
  return image;
}

}  // namespace nrff
