// The train stage: a scene artifact in, a train artifact out, with checkpoints, progress and the held-out curve.
#pragma once

#include <cstdint>
#include <filesystem>
#include <optional>
#include <string>

#include "pipeline/manifest.h"

namespace nrff {

struct TrainingRequest {
  std::filesystem::path scene_dir, out;
  std::filesystem::path base;   // an artifact of a training on fewer of the views, to go on from; empty: none
  std::string preset = "auto";  // kAutoPreset or a preset's name
  std::string settings;         // changes of the preset: ApplySettings
  std::string directional;      // of kDirectionalEncodings; empty: the preset's
  int64_t steps = 0;            // 0: the preset's
  double budget_seconds = 0;    // of training, without evaluating; 0: steps decide
  uint64_t seed = 0;
  std::optional<bool> fine_levels, sparse_depth, exposure_correction, camera_correction;  // forced either way
  std::string device = "auto";
  int n_threads = 0;   // 0: one per core
  bool check = false;  // TrainOptions::check
};

// What is asked for, without a scene: {"preset", "device", "steps", "budget_seconds", "decisions", "settings":
// {"bounded":
// {"field", "train"} or null, "unbounded": the same}}. Throws UsageError and ResourceError for presets, settings and
// devices that there are for neither kind of scene, as RunTraining would later.
Json DescribeTraining(const TrainingRequest& request);

// With a base training goes on from its checkpoint where that is of the same field in the same frame, for a share of
// the steps or the budget (needs::TrainingShare), with its preset where none is asked for. Fact "extended":
// {"steps_before", "n_views_added", "share"}, or null.
//
// `params`: what of the request was given by the caller (manifest.params).
void RunTraining(const TrainingRequest& request, const Params& params);

}  // namespace nrff
