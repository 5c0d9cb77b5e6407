// Everything that changes while a model is trained: what a checkpoint holds, and nothing else.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "model/camera_corrections.h"
#include "model/nrff_field.h"
#include "pipeline/error.h"
#include "render/occupancy_grid.h"
#include "render/scene_map.h"

namespace nrff {

// Training met numbers that are not finite and cannot go on from where it is.
class TrainingDiverged : public Error {
 public:
  explicit TrainingDiverged(const std::string& message) : Error(ExitCode::kInput, message) {}
};

// One measurement of the model on held-out views.
struct CurvePoint {
  double seconds = 0;  // of training, without evaluating
  int64_t steps = 0, samples = 0;
  double psnr = 0;        // held-out views, dB
  double train_psnr = 0;  // of the batches of late, dB
};

struct TrainState {
  TrainState(const FieldConfig& field_config, int occupancy_resolution, const SceneMap& scene_map, uint64_t seed);

  NrffField field;
  std::vector<torch::Tensor> adam_m, adam_v;  // as field.parameters()
  int64_t adam_t = 0;                         // steps since the moments were last zero
  std::vector<torch::Tensor> average;         // of the parameters (TrainConfig::average_from); empty before
  int64_t n_averaged = 0;                     // of which so many were taken
  OccupancyGrid occupancy;
  SceneMap map;

  int64_t step = 0;                             // also the counter of every random stream
  int64_t n_rays = 0;                           // of the next batch
  int64_t samples = 0;                          // density evaluations so far
  double seconds = 0;                           // spent in steps
  double progress_at_reset = 0;                 // when the learning rates last started anew
  int step_stage = 0;                           // index into TrainConfig::step_voxels
  int occupancy_updates = 0;                    // also the counter of their random streams
  int occupancy_moments_done = 0;               // of TrainConfig::occupancy_moments
  int shrink_moments_done = 0;                  // of TrainConfig::shrink_moments
  CameraCorrections cameras;                    // none before they were first looked at, or where they stay as they are
  std::vector<double> camera_displacements_px;  // CameraUpdate::displacement_px of the last look
  double camera_first_px = -1;                  // the median displacement at the first look; < 0: there was none yet
  int camera_moments_done = 0;                  // of TrainConfig::camera_moments
  int64_t n_skipped = 0;                        // steps left out for a non-finite loss or gradient
  int n_skipped_in_row = 0;
  double rate_scale = 1;  // of all learning rates: halved whenever training diverged
  int rollbacks = 0;      // times it went back to a checkpoint for that
  double train_mse = -1;  // running mean; < 0: none yet
  int evaluations = 0;    // moments of the curve that are behind
  std::vector<CurvePoint> curve;
  double seconds_evaluating = 0;
  int resumed = 0;  // times training went on from a checkpoint

  void ResetAdam();
  // One more of the parameters as they are into their mean.
  void AddToAverage();
  // The parameters change places with their mean, where there is one.
  void SwapAverage();
};

}  // namespace nrff
