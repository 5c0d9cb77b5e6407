#include "model/cuda/gpu_training.h"

#include <ATen/ATen.h>

#include <algorithm>
#include <cmath>

#include "model/cuda/gpu_model.h"
#include "pipeline/error.h"

namespace nrff {
namespace {

using torch::Tensor;

// To begin with; a step that needs more makes it.
constexpr int64_t kSamplesPerRay = 128, kShadedPerRay = 24;

GpuScene MakeGpuScene(const PixelSource& pixels, const DepthSource& depths) {
  GpuScene scene;
  scene.pixels_before.push_back(0);
  const ImagePack& pack = pixels.pack();
  scene.pack = pack.data();
  scene.pack_bytes = pack.size_bytes();
  for (const View& view : pixels.views()) {
    device::GpuView gpu{{view.fx, view.fy, view.cx, view.cy, {}}, view.width, view.channels, view.pack_offset};
    std::copy_n(view.scene_from_camera.begin(), 12, gpu.camera.scene_from_camera);
    scene.views.push_back(gpu);
    scene.pixels_before.push_back(scene.pixels_before.back() + uint64_t(view.width) * view.height);
  }
  scene.depths = depths.targets();
  return scene;
}

std::vector<Tensor> ValuesOf(const NrffField& field) {
  std::vector<Tensor> values;
  for (const NrffField::Parameter& parameter : field.parameters()) values.push_back(parameter.value.detach());
  return values;
}

}  // namespace

GpuTraining::GpuTraining(const GpuTrainerFactory& factory, const TrainState& state, const TrainConfig& config,
                         const PixelSource& pixels, const DepthSource& depths)
    : model_(MakeGpuModel(state.field)) {
  GpuTrainerOptions options;
  const bool has_depths = config.depth_weight > 0 && !depths.empty();
  options.room.rays = config.max_rays + (has_depths ? config.depth_rays : 0);
  options.room.samples = kSamplesPerRay * options.room.rays;
  options.room.shaded = std::max(kShadedPerRay * options.room.rays, config.target_shaded * 5 / 4);
  trainer_ = factory(model_, MakeGpuScene(pixels, depths), config.occupancy_resolution, options);
  Upload(state);
}

void GpuTraining::Upload(const TrainState& state) {
  const std::vector<float> parameters = Flatten(model_, ValuesOf(state.field));
  const std::vector<float> m = Flatten(model_, state.adam_m), v = Flatten(model_, state.adam_v);
  trainer_->SetState(parameters.data(), m.data(), v.data(), state.adam_t);
  if (!state.average.empty()) trainer_->SetAverage(Flatten(model_, state.average).data());
  SetOccupancy(state.occupancy);
}

void GpuTraining::Download(TrainState& state) const {
  const c10::NoGradGuard no_grad;
  std::vector<float> parameters(model_.n_parameters), m(parameters.size()), v(parameters.size());
  trainer_->GetState(parameters.data(), m.data(), v.data());
  Unflatten(model_, parameters, ValuesOf(state.field));
  Unflatten(model_, m, state.adam_m);
  Unflatten(model_, v, state.adam_v);
  if (state.n_averaged == 0) return;
  if (state.average.empty()) {
    for (const Tensor& value : ValuesOf(state.field)) state.average.push_back(at::empty_like(value));
  }
  trainer_->GetAverage(parameters.data());
  Unflatten(model_, parameters, state.average);
}

void GpuTraining::SetOccupancy(const OccupancyGrid& occupancy) { trainer_->SetOccupancy(occupancy.bits()); }

std::optional<GpuTraining::Found> GpuTraining::Step(const Batch& batch, const SceneMap& map,
                                                    const RenderOptions& options, const LossWeights& weights,
                                                    const TrainConfig& config, const Rates& rates) {
  device::StepControl control;
  control.seed = batch.seed;
  control.step = batch.step;
  control.n_rays = batch.n_rays;
  control.n_depths = batch.n_depths;
  control.jitter = options.jitter.has_value();
  control.march_step = options.step;
  control.near = options.near;
  control.far = options.far;
  control.map = map;
  control.stop_transmittance = float(options.stop_transmittance);
  control.weight_threshold = float(options.weight_threshold);
  control.background = float(options.background);
  control.orientation = float(weights.orientation);
  control.density_l1 = float(weights.density_l1);
  control.sparsity = float(weights.sparsity);
  control.depth = float(weights.depth);
  control.grid_rate = rates.grid;
  control.network_rate = rates.network;
  control.beta1 = config.beta1;
  control.beta2 = config.beta2;
  control.epsilon = config.epsilon;
  control.lazy_grids = config.lazy_grids;
  const std::optional<device::StepResult> result = trainer_->Step(control);
  if (!result) return std::nullopt;
  return Understand(*result);
}

std::vector<GpuTraining::Found> GpuTraining::Finish() {
  std::vector<Found> found;
  for (const device::StepResult& result : trainer_->Finish()) found.push_back(Understand(result));
  return found;
}

GpuTraining::Found GpuTraining::Understand(const device::StepResult& result) const {
  Found found;
  found.result = {result.mse, result.orientation, result.sparsity, result.depth, result.n_samples, result.n_shaded};
  found.n_rays = result.n_rays;
  found.adam_t = result.adam_t;
  found.step = result.step;
  found.had_room = result.had_room != 0;
  if (result.first_not_finite == ~0ULL) return found;
  const auto at = int64_t(result.first_not_finite);
  int64_t before = 0;
  for (const GpuModel::Segment& segment : model_.segments) {
    if (at < segment.begin + segment.n) {
      found.not_finite = before + std::max<int64_t>(0, at - segment.begin);
      break;
    }
    before += segment.n;
  }
  return found;
}

void GpuTraining::AddToAverage(int64_t n_averaged) { trainer_->AddToAverage(n_averaged); }

void GpuTraining::DensityOf(const float* points, int64_t n, float* sigma) const {
  const std::lock_guard lock(mutex_);
  trainer_->Densities(points, n, sigma);
}

}  // namespace nrff
