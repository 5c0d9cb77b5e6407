// Training on a GPU between tensors and the GPU's own memory (gpu_trainer.h).
#pragma once

#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <vector>

#include "model/config.h"
#include "model/cuda/gpu_factory.h"
#include "model/depth_batch.h"
#include "model/ray_batch.h"
#include "model/train_state.h"
#include "model/training_step.h"
#include "render/image_renderer.h"

namespace nrff {

// The training's state lies on the GPU; a TrainState on the host holds it after Download alone.
class GpuTraining : public DensitySource {
 public:
  // `state`: to begin with. Throws ResourceError when the model has no room on the GPU at all.
  GpuTraining(const GpuTrainerFactory& factory, const TrainState& state, const TrainConfig& config,
              const PixelSource& pixels, const DepthSource& depths);

  // Parameters, moments, mean and occupancy grid, from and to the host. Download waits.
  void Upload(const TrainState& state);
  void UploadParameters(const TrainState& state);
  void Download(TrainState& state) const;
  void SetOccupancy(const OccupancyGrid& occupancy);
  // As they are now: the same ones with other cameras.
  void SetViews(const PixelSource& pixels);

  // As the CPU's step, of `batch`: n_rays, n_depths, seed and step alone decide which rays. Queued: what comes back is
  // what an earlier step found (GpuTrainer::kLag).
  struct Batch {
    int64_t n_rays = 0, n_depths = 0;
    uint64_t seed = 0, step = 0;
  };
  struct Found {
    TrainingStep::Result result;
    int64_t n_rays = 0, adam_t = 0;
    uint64_t step = 0;
    bool had_room = true;     // or the step changed nothing and is to be forgotten
    int64_t not_finite = -1;  // the gradient's element among all parameters, counted without gaps; −1: none
  };
  std::optional<Found> Step(const Batch& batch, const SceneMap& map, const RenderOptions& options,
                            const LossWeights& weights, const TrainConfig& config, const LearningRates& rates);
  std::vector<Found> Finish();

  void AddToAverage(int64_t n_averaged);

  // Rays, an image one pixel high (RenderRayImage), as `state`, a changed one of the training's, shows them;
  // UploadParameters sets back what this does.
  RenderedImage RenderImage(const TrainState& state, const Rays& rays, const RenderOptions& options);

  void DensityOf(const float* points, int64_t n, float* sigma) const override;
  int64_t points_at_once() const override { return int64_t{1} << 18; }

 private:
  Found Understand(const device::StepResult& result) const;

  GpuModel model_;
  std::unique_ptr<GpuTrainer> trainer_;
  mutable std::mutex mutex_;  // of trainer_, which is one thread's
};

}  // namespace nrff
