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

}  // namespace

GpuTraining::GpuTraining(const GpuTrainerFactory& factory, const TrainState& state, const TrainConfig& config,
                         const PixelSource& pixels, const DepthSource& depths)
    : model_(MakeGpuModel(state.field)) {
  GpuTrainerOptions options;
  const bool has_depths = config.depth_weight > 0 && !depths.empty();
  options.room.rays = config.max_rays + (has_depths ? config.depth_rays : 0);
  options.room.samples = kSamplesPerRay * options.room.rays;
  options.room.shaded = std::max(kShadedPerRay * options.room.rays, config.target_shaded * 5 / 4);
  try {
    trainer_ = factory(model_, MakeGpuScene(pixels, depths), config.occupancy_resolution, options);
  } catch (const std::exception& error) {
    throw ResourceError(
        std::string(error.what()) +
        "; choose a smaller model with --preset, smaller photos with --max-image-size, or --device cpu");
  }
  Upload(state);
}

void GpuTraining::UploadParameters(const TrainState& state) {
  trainer_->SetParameters(Flatten(model_, ValuesOf(state.field)).data());
}

void GpuTraining::Upload(const TrainState& state) {
  UploadParameters(state);
  trainer_->SetMoments(Flatten(model_, state.adam_m).data(), Flatten(model_, state.adam_v).data(), state.adam_t);
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

void GpuTraining::SetViews(const PixelSource& pixels) { trainer_->SetViews(MakeGpuViews(pixels)); }

std::optional<GpuTraining::Found> GpuTraining::Step(const Batch& batch, const SceneMap& map,
                                                    const RenderOptions& options, const LossWeights& weights,
                                                    const TrainConfig& config, const LearningRates& rates) {
  device::StepControl control = MakeControl(map, options);
  control.seed = batch.seed;
  control.step = batch.step;
  control.n_rays = batch.n_rays;
  control.n_depths = batch.n_depths;
  control.orientation = float(weights.orientation);
  control.density_l1 = float(weights.density_l1);
  control.sparsity = float(weights.sparsity);
  control.depth = float(weights.depth);
  control.correction = float(weights.correction);
  control.grid_rate = rates.grid;
  control.network_rate = rates.network;
  control.correction_rate = rates.correction;
  control.beta1 = config.beta1;
  control.beta2 = config.beta2;
  control.epsilon = config.epsilon;
  control.lazy_grids = config.lazy_grids;
  const std::optional<device::StepResult> result = OnGpu([&] { return trainer_->Step(control); });
  if (!result) return std::nullopt;
  return Understand(*result);
}

std::vector<GpuTraining::Found> GpuTraining::Finish() {
  std::vector<Found> found;
  for (const device::StepResult& result : OnGpu([&] { return trainer_->Finish(); }))
    found.push_back(Understand(result));
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

RenderedImage GpuTraining::RenderImage(const TrainState& state, const Rays& rays, const RenderOptions& options) {
  UploadParameters(state);
  const Tensor origins = rays.origins.contiguous(), directions = rays.directions.contiguous();
  const int64_t n = origins.size(0);
  RenderedImage image;
  image.width = int(n);
  image.height = 1;
  image.rgb.resize(size_t(3 * n));
  image.depth.resize(size_t(n));
  image.normal.resize(size_t(3 * n));
  image.opacity.resize(size_t(n));
  GpuRays of;
  of.n = n;
  of.origins = origins.const_data_ptr<float>();
  of.directions = directions.const_data_ptr<float>();
  OnGpu([&] {
    return trainer_->Render(of, MakeControl(state.map, options),
                            {image.rgb.data(), image.depth.data(), image.normal.data(), image.opacity.data()});
  });
  NormaliseGeometry(image);
  return image;
}

void GpuTraining::DensityOf(const float* points, int64_t n, float* sigma) const {
  const std::lock_guard lock(mutex_);
  trainer_->Densities(points, n, sigma);
}

}  // namespace nrff
