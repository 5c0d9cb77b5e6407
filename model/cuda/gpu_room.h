// How much memory a step on a GPU gets: enough for the samples of late steps, not much more, since the networks work on
// all rows that there is room for.
#pragma once

#include <cstdint>

#include "model/cuda/gpu_trainer.h"

namespace nrff {

class GpuRoomPlan {
 public:
  // Begins with at least this.
  explicit GpuRoomPlan(const GpuRoom& room);

  const GpuRoom& room() const { return room_; }
  int64_t most_rays() const { return most_rays_; }

  // After a step that had `had` room and found so many samples. Returns whether room() changed.
  bool Observe(const GpuRoom& had, int64_t n_samples, int64_t n_shaded);

  // There is no memory for room(): half of the rays and of what they need from now on, which is never taken back.
  // Returns false when there is nothing left to halve.
  bool Halve();

 private:
  GpuRoom room_;
  int64_t most_rays_;
  int64_t most_samples_ = 0, most_shaded_ = 0;  // of the present window
  int n_observed_ = 0;
};

}  // namespace nrff
