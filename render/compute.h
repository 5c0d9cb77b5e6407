// Where the arithmetic of training and rendering runs.
#pragma once

#include <string>

#include "pipeline/needs.h"

namespace nrff {

// Threads of the kernels and of torch, which share one OpenMP pool; ≤ 0: one per core this process may use. Returns
// the number.
int SetThreads(int n_threads);

// `device` as given by --device: "auto", "cpu" or "cuda". Returns the decision to record; throws ResourceError when
// CUDA is asked for and cannot be had.
Decision ChooseDevice(const std::string& device);

}  // namespace nrff
