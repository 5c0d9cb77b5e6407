// What a training on views that were added to those of another starts from: that one's checkpoint.
#pragma once

#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

#include "model/train_state.h"

namespace nrff {

struct BaseTraining {
  std::string settings;  // its SaveCheckpoint's
  int64_t steps = 0;
  std::vector<float> corrections;  // of its training views' colours, in their order; empty: it had none
};

// Reads what says whether the checkpoint in `dir` can be gone on from. Throws CorruptError when it cannot be read.
BaseTraining ReadBaseTraining(const std::filesystem::path& dir);

// Fills the parameters of `state`, which has the same field but for corrected views, with the checkpoint's mean (or
// its parameters, where it has none), and takes over Adam's moments of all but the corrections, cameras, the box, the
// number of rays, and the occupancy: cells that the views of `state` see and the checkpoint's did not have yet to be
// measured. Counters start at 0, moments of the schedule are those that are behind, but for looks at cameras, which
// are taken again, at all views. Throws CorruptError as LoadCheckpoint.
void LoadBase(const std::filesystem::path& dir, TrainState& state);

}  // namespace nrff
