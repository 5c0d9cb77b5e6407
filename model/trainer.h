// Trains an NrffField on the pixels of a scene's training views.
//
// A step is a function of (state, scene, configuration, seed) alone when training is counted in steps: on one thread,
// training that is stopped after step k and goes on from its checkpoint gives the same bits as training that never
// stopped. With a budget of seconds the schedule follows the clock instead.
#pragma once

#include <cstdint>
#include <filesystem>
#include <memory>
#include <string>
#include <vector>

#include "model/base_training.h"
#include "model/config.h"
#include "model/cuda/gpu_training.h"
#include "model/depth_batch.h"
#include "model/ray_batch.h"
#include "model/train_state.h"
#include "model/training_step.h"
#include "pipeline/json.h"
#include "pipeline/scene.h"
#include "render/image_renderer.h"

namespace nrff {

struct TrainOptions {
  double budget_seconds = 0;  // of training; 0: config.steps decide
  uint64_t seed = 0;
  // Ends at the first number that is not finite, and looks for one in every parameter and moment after every step, too.
  bool check = false;
  GpuTrainerFactory gpu = {};  // trains there; null: on the CPU
};

class Trainer {
 public:
  // Starts from scratch. Keeps references to scene and pack. Throws InputError when the scene cannot be trained on.
  // `depths`: of scene; may be empty.
  Trainer(const Scene& scene, const ImagePack& pack, const std::vector<SparseDepth>& depths, const Preset& preset,
          const TrainOptions& options);

  // Goes on from another training, of fewer of the views; before the first step, and never with another scene's frame.
  // `views`: ids of its training views, in the order of its corrections; views that it had no correction of start with
  // their gain. The schedule begins where all its changes are behind (SettledProgress).
  void Extend(const std::filesystem::path& checkpoint_dir, const BaseTraining& base,
              const std::vector<std::string>& views);

  // Of this training, 0 to 1.
  double Progress() const;
  // With a budget: when another step would end farther from it than this one did. There is one step at least.
  bool Done() const;

  // One step of the optimiser and what the schedule has due before it. A non-finite loss or gradient leaves the model
  // as it is and is counted; throws TrainingDiverged saying what was met when that happens kMostSkipped times in a
  // row, with TrainOptions::check at once and also when the step leaves a parameter or moment that is not finite.
  void Step();
  static constexpr int kMostSkipped = 20;

  // On a GPU, the parameters, moments and mean of state() are those of the last Sync.
  void Sync();
  // To be called when state() was changed from outside.
  void StateChanged();
  TrainState& state() { return state_; }
  const TrainState& state() const { return state_; }
  const Preset& preset() const { return preset_; }
  // Of the scene, as its camera is corrected.
  View Corrected(const View& view) const { return state_.cameras.Corrected(view); }

  // How images of the present model are rendered.
  RenderOptions EvaluationOptions() const;

  // Colours [n, 3] of rays of a view, in its exposure, by the mean of the parameters, or by the parameters where there
  // is none. After Sync.
  torch::Tensor RenderMean(const View& view, const Rays& rays);

  // Throws TrainingDiverged when a parameter or a moment of Adam's is not finite. After Sync.
  void CheckState() const;

  // What a person needs to find out why training diverged: {step, seed: which together give the batch, n_rays,
  // n_skipped, rate_scale, rollbacks, parameters [{name, largest: of the finite ones' size, n_not_finite}]}.
  Json Evidence();

  // dB; NaN before the first step.
  double TrainPsnr() const;

 private:
  // What a step found, wherever it was done.
  struct Found {
    TrainingStep::Result result;
    int64_t step = 0, n_rays = 0;
    std::string not_finite;  // what is, or empty
  };
  // Of the views' colours: from the gains that the scene gives.
  void StartCorrections();
  double ScheduleProgress() const;
  void FollowSchedule(double progress);
  void ResetAdam();
  void Settle();    // accounts for all steps that were queued
  void Download();  // Sync within a step
  void StepOnCpu(double progress, const RenderOptions& options, const LossWeights& weights);
  void StepOnGpu(double progress, const RenderOptions& options, const LossWeights& weights);
  void Account(const GpuTraining::Found& found);
  void Account(const Found& found);
  bool AveragesNow() const;
  void UpdateOccupancy(bool all_cells);
  // The training views' as the state has them corrected.
  void MoveCameras();
  // Corrects them once more, or finds at the first look that they stay.
  void CorrectCameras();
  // By the parameters that the state has.
  RenderedImage Show(const Rays& rays);
  // In the exposure of each ray's training view, view [n] int32.
  RenderedImage RenderTraining(const Rays& rays, const torch::Tensor& view);
  void Shrink();
  // What of the CPU's step is not finite, if anything.
  std::string NotFinite(const TrainingStep::Result& result) const;
  // "level 3 (40 nodes) of density_grid" for the first element that is not finite; empty where there is none.
  std::string NotFiniteIn(const torch::Tensor& values, size_t parameter) const;
  std::string Where(size_t parameter, int64_t element) const;
  LearningRates Rates(double progress) const;
  void Optimise(double progress);

  const Scene& scene_;
  Preset preset_;
  TrainOptions options_;
  PixelSource pixels_;
  std::vector<View> training_views_;  // as the scene has them
  DepthSource depths_;
  double background_;
  TrainState state_;
  double progress_from_ = 0;  // where the schedule begins: Extend
  double step_seconds_ = 0;   // of the last step
  TrainingStep step_;         // of state_.field
  std::unique_ptr<GpuTraining> gpu_;
};

}  // namespace nrff
