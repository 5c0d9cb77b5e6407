// What changes over a training, as functions of how far it has come.
#pragma once

#include <vector>

#include "model/config.h"
#include "render/scene_map.h"

namespace nrff {

// `progress` runs from 0 to 1.

// Factor on the learning rates; they last started anew at `progress_at_reset`.
double RateFactor(const TrainConfig& config, double progress, double progress_at_reset);

// How many of the ascending moments have come.
int MomentsBehind(const std::vector<double>& moments, double progress);

// Index into config.step_voxels.
int StepStage(const TrainConfig& config, double progress);

// Marching step of a stage: RenderOptions::step.
double MarchingStep(const TrainConfig& config, int stage, const SceneMap& map);

// RenderOptions::weight_threshold.
double WeightThreshold(const TrainConfig& config, double progress);

// Where all is behind that comes at a moment; half the way at the least. A training that extends another starts there.
double SettledProgress(const TrainConfig& config);

// Moments of the held-out curve: `n` fractions of the training, log-spaced up to 1.
double CurveMoment(int index);
inline constexpr int kCurvePoints = 10;

}  // namespace nrff
