// What a step on a GPU is told, and what it finds. Both lie on the device, so that a graph of the step can be queued
// again.
#pragma once

#include <cstdint>

#include "render/kernels/camera_rays.h"
#include "render/scene_map.h"

namespace nrff::device {

struct StepControl {
  uint64_t seed = 0, step = 0;  // of the random streams
  int64_t n_rays = 0, n_depths = 0;
  bool jitter = true;
  double march_step = 0, near = 0, far = 0;  // MarchArgs
  SceneMap map;
  float stop_transmittance = 0, weight_threshold = 0, background = 0;
  // Pictures alone: a ray's samples of least weight are left out as long as their weights sum to at most this.
  float colour_tolerance = 0;
  // LossWeights of model/training_step.h
  float orientation = 0, density_l1 = 0, sparsity = 0, depth = 0, correction = 0;
  // AdamOptions of model/kernels/adam.h
  double grid_rate = 0, network_rate = 0, correction_rate = 0, beta1 = 0.9, beta2 = 0.99, epsilon = 1e-8;
  bool lazy_grids = false;
};

// What a step found.
struct StepResult {
  double mse = 0, orientation = 0, sparsity = 0, depth = 0;  // TrainingStep::Result
  int64_t n_samples = 0, n_shaded = 0;                       // also where there was no room for them
  unsigned long long first_not_finite = 0;                   // gradient's index among the parameters, ~0: none
  int64_t adam_t = 0;                                        // behind the step
  uint64_t step = 0;                                         // StepControl::step
  int64_t n_rays = 0;                                        // with colours
  int had_room = 0, applied = 0;                             // applied: whether the step changed the model
};

struct GpuView {
  PinholeCamera camera;
  int width = 0, height = 0, n_channels = 3;
  int64_t rows_before = -1;  // where CountingPixel's begin among all views'; < 0: every pixel counts
  uint64_t pack_offset = 0;  // bytes
};

}  // namespace nrff::device
