#include "model/trainer.h"

#include <ATen/ATen.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <optional>
#include <utility>

#include "model/camera_update.h"
#include "model/kernels/adam.h"
#include "model/schedule.h"
#include "model/view_colours.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/log.h"
#include "pipeline/statistics.h"
#include "render/kernels/colour_correction.h"

namespace nrff {
namespace {

using torch::Tensor;

constexpr double kMseMemory = 0.98;       // of the running mean of the batches' error
constexpr double kLeastShrinking = 0.95;  // a box whose volume shrinks less than to this stays as it is
constexpr double kStray = 1e-3;           // of the occupied cells: less that hangs together does not hold the box open
constexpr int64_t kFewestRays = 64;
// Looks at the cameras: of all views together, of each, and how much less of a step each makes than the one before.
constexpr int kMostSightings = 20000, kFewestSightings = 40;
constexpr double kLossOfGain = 0.5, kLeastGain = 0.2;

std::vector<View> TrainingViews(const Scene& scene) {
  std::vector<View> views;
  for (const int i : scene.ViewsOf(Split::kTrain)) views.push_back(scene.views[i]);
  return views;
}

// All poses are looked at before hours are spent on them.
const Scene& Checked(const Scene& scene) {
  for (const View& view : scene.views) {
    const auto finite = [](double x) { return std::isfinite(x); };
    if (!std::all_of(view.scene_from_camera.begin(), view.scene_from_camera.end(), finite) || !(view.fx > 0) ||
        !(view.fy > 0) || !finite(view.cx) || !finite(view.cy)) {
      throw InputError("view " + view.name + " has a camera that is not finite; leave it out or correct its pose");
    }
  }
  for (int k = 0; k < 3; ++k) {
    if (!(scene.aabb_max[k] - scene.aabb_min[k] > 0)) {
      throw InputError("the scene's box has no size along " + std::string(1, char('x' + k)) +
                       "; run the pose stage again, with a box that holds the object");
    }
  }
  return scene;
}

std::string NotFiniteLoss(const TrainingStep::Result& result) {
  for (const auto& [name, loss] : {std::pair("colour", result.mse),
                                   {"orientation", result.orientation},
                                   {"sparsity", result.sparsity},
                                   {"depth", result.depth}}) {
    if (std::isfinite(loss)) continue;
    return std::string(std::isnan(loss) ? "a loss that is not a number (" : "an infinite loss (") + name + ")";
  }
  return {};
}

}  // namespace

Trainer::Trainer(const Scene& scene, const ImagePack& pack, const std::vector<SparseDepth>& depths,
                 const Preset& preset, const TrainOptions& options)
    : scene_(Checked(scene)),
      preset_(preset),
      options_(options),
      pixels_(TrainingViews(scene), pack, BackgroundLevel(scene, preset.train.unknown_background)),
      training_views_(pixels_.views()),
      depths_(scene, depths),
      background_(BackgroundLevel(scene, preset.train.unknown_background)),
      state_(preset.field, preset.train.occupancy_resolution,
             SceneMap::FromBox(scene.aabb_min, scene.aabb_max, scene.unbounded), options.seed),
      step_(state_.field) {
  state_.n_rays = preset_.train.rays;
  StartCorrections();
  if (scene_.unbounded && preset_.train.occupancy_min_views > 0) {
    const int n_views = int(pixels_.views().size());
    state_.occupancy.MarkSeen(pixels_.views(), state_.map, scene_.near,
                              std::min(n_views, preset_.train.occupancy_min_views));
  }
  if (options.gpu) gpu_ = std::make_unique<GpuTraining>(options.gpu, state_, preset_.train, pixels_, depths_);
}

void Trainer::StartCorrections() {
  if (preset_.field.corrected_views == 0) return;
  const c10::NoGradGuard no_grad;
  auto* correction = state_.field.colour_corrections().mutable_data_ptr<float>();
  for (const View& view : pixels_.views()) {
    for (int c = 0; c < kCorrectionRows; ++c) correction[kCorrectionColumns * c + c] = float(view.colour_gain[c] - 1);
    correction += kCorrectionParameters;
  }
}

void Trainer::Extend(const std::filesystem::path& checkpoint_dir, const BaseTraining& base,
                     const std::vector<std::string>& views) {
  LoadBase(checkpoint_dir, state_);
  progress_from_ = SettledProgress(preset_.train);
  if (preset_.field.corrected_views > 0 && !base.corrections.empty()) {
    if (base.corrections.size() != views.size() * size_t{kCorrectionParameters}) {
      throw CorruptError(EscapePath(checkpoint_dir) + " has corrections of other views than it names");
    }
    const c10::NoGradGuard no_grad;
    auto* correction = state_.field.colour_corrections().mutable_data_ptr<float>();
    for (const View& view : pixels_.views()) {
      const auto before = std::find(views.begin(), views.end(), view.id);
      if (before != views.end()) {
        const float* values = base.corrections.data() + (before - views.begin()) * kCorrectionParameters;
        std::copy_n(values, size_t{kCorrectionParameters}, correction);
      }
      correction += kCorrectionParameters;
    }
  }
  if (!state_.cameras.poses.empty()) state_.cameras = state_.cameras.Of(training_views_);
  StateChanged();
  UpdateOccupancy(/*all_cells=*/true);  // also what added views are the first to see
}

double Trainer::Progress() const {
  return options_.budget_seconds > 0 ? state_.seconds / options_.budget_seconds
                                     : double(state_.step) / double(preset_.train.steps);
}

double Trainer::ScheduleProgress() const { return progress_from_ + (1 - progress_from_) * Progress(); }

bool Trainer::Done() const {
  if (options_.budget_seconds <= 0) return Progress() >= 1;
  return state_.step > 0 && state_.seconds + 0.5 * step_seconds_ >= options_.budget_seconds;
}

RenderOptions Trainer::EvaluationOptions() const {
  RenderOptions options;
  options.step = MarchingStep(preset_.train, state_.step_stage, state_.map);
  options.near = scene_.near;
  options.far = scene_.far;
  options.weight_threshold = WeightThreshold(preset_.train, ScheduleProgress());
  options.stop_transmittance = options.weight_threshold;
  options.background = background_;
  return options;
}

RenderedImage Trainer::Show(const Rays& rays) {
  const RenderOptions options = EvaluationOptions();
  return gpu_ ? gpu_->RenderImage(state_, rays, options)
              : RenderRayImage(state_.field, state_.occupancy, state_.map, rays, options);
}

Tensor Trainer::RenderMean(const View& view, const Rays& rays) {
  const c10::NoGradGuard no_grad;
  state_.SwapAverage();
  RenderedImage image = Show(rays);
  const ViewColours colours(state_.field, pixels_.views());
  if (!colours.empty())
    CorrectColours(colours.Of(view), background_, image.width, image.opacity.data(), image.rgb.data());
  state_.SwapAverage();
  if (gpu_) gpu_->UploadParameters(state_);
  return at::tensor(image.rgb).view({-1, 3});
}

double Trainer::TrainPsnr() const { return -10 * std::log10(state_.train_mse < 0 ? NAN : state_.train_mse); }

void Trainer::UpdateOccupancy(bool all_cells) {
  const TrainConfig& config = preset_.train;
  OccupancyGrid::UpdateOptions options;
  // Over the last stage's step, so that opacities measured in different stages can be compared.
  options.step = MarchingStep(config, int(config.step_voxels.size()) - 1, state_.map);
  options.decay = float(config.occupancy_decay);
  options.threshold = float(config.occupancy_threshold);
  if (!all_cells) options.n_random = options.n_occupied = config.occupancy_cells / 2;
  options.seed = options_.seed;
  options.counter = uint64_t(state_.occupancy_updates);
  options.dilate = config.occupancy_dilate;
  if (gpu_) {
    state_.occupancy.Update(*gpu_, options);
    gpu_->SetOccupancy(state_.occupancy);
  } else {
    state_.occupancy.Update(state_.field, options);
  }
  ++state_.occupancy_updates;
}

void Trainer::MoveCameras() {
  std::vector<View> views;
  for (const View& view : training_views_) views.push_back(state_.cameras.Corrected(view));
  pixels_.MoveViews(std::move(views));
  if (gpu_) gpu_->SetViews(pixels_);
}

RenderedImage Trainer::RenderTraining(const Rays& rays, const Tensor& view) {
  const c10::NoGradGuard no_grad;
  RenderedImage image = Show(rays);
  const ViewColours colours(state_.field, pixels_.views());
  if (colours.empty()) return image;
  const auto* of = view.const_data_ptr<int32_t>();
  const int64_t n = view.size(0);
  for (int64_t first = 0, end = 0; first < n; first = end) {
    while (end < n && of[end] == of[first]) ++end;
    CorrectColours(colours.Of(pixels_.views()[size_t(of[first])]), background_, end - first,
                   image.opacity.data() + first, image.rgb.data() + 3 * first);
  }
  return image;
}

void Trainer::CorrectCameras() {
  const TrainConfig& config = preset_.train;
  const bool first = state_.camera_first_px < 0;
  if (!first && state_.cameras.poses.empty()) return;  // they stay
  Download();
  const CameraUpdate update =
      UpdateCameras(pixels_, training_views_, first ? CameraCorrections::None(training_views_) : state_.cameras,
                    [&](const Rays& rays, const Tensor& view) { return RenderTraining(rays, view); },
                    {.n_pixels = std::max(kFewestSightings,
                                          std::min(config.camera_pixels, kMostSightings / int(training_views_.size()))),
                     .gain = std::max(kLeastGain, 1 / (1 + kLossOfGain * state_.camera_moments_done)),
                     .seed = options_.seed,
                     .counter = uint64_t(state_.camera_moments_done)});
  if (first) {
    state_.camera_first_px = Median(update.displacement_px);
    if (state_.camera_first_px < config.camera_least_px) return;
  }
  state_.cameras = update.corrections;
  state_.camera_displacements_px = update.displacement_px;
  MoveCameras();
}

void Trainer::Shrink() {
  const OccupancyGrid::Box box = state_.occupancy.OccupiedBox(kStray);
  double volume = 1;
  for (int k = 0; k < 3; ++k) volume *= (box.max[k] - box.min[k]) / 2;
  if (volume > kLeastShrinking) return;
  std::array<double, 3> low, high;
  state_.map.ToScene(box.min.data(), low.data());
  state_.map.ToScene(box.max.data(), high.data());
  Download();
  state_.field.Crop(box.min, box.max);
  state_.map = SceneMap::FromBox(low, high, false);
  state_.ResetAdam();
  state_.occupancy = OccupancyGrid(preset_.train.occupancy_resolution);
  StateChanged();
  UpdateOccupancy(/*all_cells=*/true);
  LogDetail("the box shrinks to " + std::to_string(int(std::lround(100 * volume))) + " % of its volume");
}

void Trainer::FollowSchedule(double progress) {
  const TrainConfig& config = preset_.train;
  const int stage = StepStage(config, progress);
  if (stage != state_.step_stage && config.reset_with_step) {
    ResetAdam();
    state_.progress_at_reset = progress;
  }
  state_.step_stage = stage;

  if (config.occupancy_interval > 0) {
    if (state_.step > 0 && state_.step % config.occupancy_interval == 0) {
      UpdateOccupancy(config.occupancy_cells == 0 || state_.occupancy_updates == 0);
    }
  } else {
    const int n_due = MomentsBehind(config.occupancy_moments, progress);
    if (state_.occupancy_moments_done < n_due) UpdateOccupancy(/*all_cells=*/true);
    state_.occupancy_moments_done = n_due;
  }
  const int n_looks = MomentsBehind(config.camera_moments, progress);
  if (state_.camera_moments_done < n_looks) CorrectCameras();
  state_.camera_moments_done = n_looks;
  if (!scene_.unbounded && state_.occupancy_updates > 0) {
    const int n_due = MomentsBehind(config.shrink_moments, progress);
    if (state_.shrink_moments_done < n_due) Shrink();
    state_.shrink_moments_done = n_due;
  }
}

void Trainer::Step() {
  const auto start = std::chrono::steady_clock::now();
  const TrainConfig& config = preset_.train;
  const double progress = ScheduleProgress();
  FollowSchedule(progress);
  RenderOptions options = EvaluationOptions();
  options.jitter = {options_.seed, uint64_t(state_.step)};
  const LossWeights weights{.orientation = config.orientation_weight,
                            .density_l1 = MomentsBehind(config.shrink_moments, progress) == 0
                                              ? config.density_l1_weight
                                              : config.density_l1_weight_later,
                            .sparsity = config.sparsity_weight,
                            .depth = depths_.empty() ? 0 : config.depth_weight,
                            .correction = config.correction_weight};
  if (gpu_) {
    StepOnGpu(progress, options, weights);
  } else {
    StepOnCpu(progress, options, weights);
  }
  if (options_.check) {
    Download();
    CheckState();
  }
  ++state_.step;
  step_seconds_ = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  state_.seconds += step_seconds_;
}

void Trainer::StepOnCpu(double progress, const RenderOptions& options, const LossWeights& weights) {
  const PixelSource::Batch batch = pixels_.Draw(state_.n_rays, options_.seed, uint64_t(state_.step));
  std::optional<DepthSource::Batch> depths;
  if (weights.depth > 0) {
    depths = depths_.Draw(preset_.train.depth_rays, options_.seed, uint64_t(state_.step), state_.map, options.step);
  }
  const TrainingStep::Result result =
      step_.Run(batch, depths ? &*depths : nullptr, state_.occupancy, state_.map, options, weights);
  const std::string not_finite = NotFinite(result);
  if (not_finite.empty()) {
    Optimise(progress);
    if (AveragesNow()) state_.AddToAverage();
  }
  Account({result, state_.step, state_.n_rays, not_finite});
}

// What is not finite changes nothing there, either; it is heard of a few steps later, so that the mean may have taken
// the parameters in twice.
void Trainer::StepOnGpu(double progress, const RenderOptions& options, const LossWeights& weights) {
  const GpuTraining::Batch batch{state_.n_rays, weights.depth > 0 ? preset_.train.depth_rays : 0, options_.seed,
                                 uint64_t(state_.step)};
  const auto found = gpu_->Step(batch, state_.map, options, weights, preset_.train, Rates(progress));
  if (AveragesNow()) gpu_->AddToAverage(++state_.n_averaged);
  if (found) Account(*found);
}

void Trainer::Account(const GpuTraining::Found& found) {
  state_.adam_t = found.adam_t;
  if (!found.had_room) return;
  std::string not_finite = NotFiniteLoss(found.result);
  if (not_finite.empty() && found.not_finite >= 0) {
    size_t parameter = 0;
    int64_t element = found.not_finite;
    while (element >= state_.field.parameters()[parameter].value.numel()) {
      element -= state_.field.parameters()[parameter++].value.numel();
    }
    not_finite = "a non-finite gradient of " + Where(parameter, element);
  }
  Account({found.result, int64_t(found.step), found.n_rays, not_finite});
}

void Trainer::Account(const Found& found) {
  const TrainConfig& config = preset_.train;
  if (found.not_finite.empty()) {
    state_.n_skipped_in_row = 0;
    state_.train_mse =
        state_.train_mse < 0 ? found.result.mse : kMseMemory * state_.train_mse + (1 - kMseMemory) * found.result.mse;
  } else {
    ++state_.n_skipped;
    if (options_.check) {
      throw TrainingDiverged("training met " + found.not_finite + " at step " + std::to_string(found.step));
    }
    if (++state_.n_skipped_in_row == kMostSkipped) {
      throw TrainingDiverged("training met " + found.not_finite + " in each of " + std::to_string(kMostSkipped) +
                             " steps up to step " + std::to_string(found.step) +
                             "; look for wrong poses in the scene, or lower the preset's rates");
    }
  }
  if (config.target_shaded > 0) {
    // Half of the way, so that one unusual batch does not throw it off.
    const double wanted =
        double(found.n_rays) * double(config.target_shaded) / double(std::max<int64_t>(found.result.n_shaded, 1));
    state_.n_rays = std::clamp(int64_t(0.5 * (double(found.n_rays) + wanted)),
                               std::min(kFewestRays, int64_t(config.max_rays)), int64_t(config.max_rays));
  }
  state_.samples += found.result.n_samples;
}

bool Trainer::AveragesNow() const {
  return Progress() >= preset_.train.average_from && state_.step % preset_.train.average_interval == 0;
}

void Trainer::Sync() {
  if (!gpu_) return;
  const auto start = std::chrono::steady_clock::now();
  Settle();
  // What was queued is part of the steps.
  state_.seconds += std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  gpu_->Download(state_);
}

void Trainer::Settle() {
  if (!gpu_) return;
  for (const GpuTraining::Found& found : gpu_->Finish()) Account(found);
}

void Trainer::StateChanged() {
  MoveCameras();
  if (!gpu_) return;
  gpu_->Finish();  // of the state that is gone
  gpu_->Upload(state_);
}

void Trainer::Download() {
  Settle();
  if (gpu_) gpu_->Download(state_);
}

void Trainer::ResetAdam() {
  Download();
  state_.ResetAdam();
  StateChanged();
}

std::string Trainer::NotFinite(const TrainingStep::Result& result) const {
  std::string not_finite = NotFiniteLoss(result);
  for (size_t i = 0; not_finite.empty() && i < step_.gradients().size(); ++i) {
    const std::string where = NotFiniteIn(step_.gradients()[i], i);
    if (!where.empty()) not_finite = "a non-finite gradient of " + where;
  }
  return not_finite;
}

std::string Trainer::NotFiniteIn(const Tensor& values, size_t parameter) const {
  const auto* data = values.const_data_ptr<float>();
  if (AllFinite(data, values.numel())) return {};
  return Where(parameter,
               std::find_if(data, data + values.numel(), [](float value) { return !std::isfinite(value); }) - data);
}

std::string Trainer::Where(size_t parameter, int64_t element) const {
  const std::string& name = state_.field.parameters()[parameter].name;
  if (!state_.field.parameters()[parameter].is_grid) return name;
  const GridLayout& layout = name == "density_grid" ? state_.field.density_layout() : state_.field.appearance_layout();
  size_t entry = 0;
  while (entry + 1 < layout.levels.size() && layout.levels[entry + 1].plane_offsets[0] <= element) ++entry;
  const size_t n_entries = layout.levels.size() / size_t(state_.field.config().levels);  // of a level
  return "level " + std::to_string(entry / n_entries) + " (" + std::to_string(layout.levels[entry].resolution) +
         " nodes) of " + name;
}

void Trainer::CheckState() const {
  for (size_t i = 0; i < state_.field.parameters().size(); ++i) {
    for (const auto& [what, values] : {std::pair("value", state_.field.parameters()[i].value),
                                       {"first moment", state_.adam_m[i]},
                                       {"second moment", state_.adam_v[i]}}) {
      const std::string where = NotFiniteIn(values, i);
      if (where.empty()) continue;
      throw TrainingDiverged(std::string("training left a non-finite ") + what + " in " + where + " at step " +
                             std::to_string(state_.step) + "; lower the preset's rates");
    }
  }
}

Json Trainer::Evidence() {
  if (gpu_) {
    gpu_->Finish();
    gpu_->Download(state_);
  }
  Json parameters = Json::array();
  for (const NrffField::Parameter& parameter : state_.field.parameters()) {
    const auto* data = parameter.value.const_data_ptr<float>();
    float largest = 0;
    int64_t n_not_finite = 0;
    for (int64_t i = 0; i < parameter.value.numel(); ++i) {
      if (std::isfinite(data[i])) {
        largest = std::max(largest, std::abs(data[i]));
      } else {
        ++n_not_finite;
      }
    }
    parameters.push_back({{"name", parameter.name}, {"largest", largest}, {"n_not_finite", n_not_finite}});
  }
  return {{"step", state_.step},           {"n_rays", state_.n_rays},         {"seed", options_.seed},
          {"n_skipped", state_.n_skipped}, {"rate_scale", state_.rate_scale}, {"rollbacks", state_.rollbacks},
          {"parameters", parameters}};
}

LearningRates Trainer::Rates(double progress) const {
  const TrainConfig& config = preset_.train;
  const double factor = state_.rate_scale * RateFactor(config, progress, state_.progress_at_reset);
  return {factor * config.grid_rate, factor * config.network_rate, factor * config.correction_rate};
}

void Trainer::Optimise(double progress) {
  const TrainConfig& config = preset_.train;
  ++state_.adam_t;
  const std::vector<NrffField::Parameter>& parameters = state_.field.parameters();
  const LearningRates rates = Rates(progress);
  for (size_t i = 0; i < parameters.size(); ++i) {
    const bool correction = parameters[i].value.is_same(state_.field.colour_corrections());
    const AdamOptions options{.learning_rate = parameters[i].is_grid ? rates.grid
                                               : correction          ? rates.correction
                                                                     : rates.network,
                              .beta1 = config.beta1,
                              .beta2 = config.beta2,
                              .epsilon = config.epsilon,
                              .lazy = parameters[i].is_grid && config.lazy_grids};
    const Tensor& gradient = step_.gradients()[i];
    AdamStep(options, state_.adam_t, gradient.numel(), gradient.const_data_ptr<float>(),
             parameters[i].value.mutable_data_ptr<float>(), state_.adam_m[i].mutable_data_ptr<float>(),
             state_.adam_v[i].mutable_data_ptr<float>());
  }
}

}  // namespace nrff
