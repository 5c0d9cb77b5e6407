// The GPU that tests train on: the machine's own (gpu_under_test_cuda.cc), or the emulation (emulation/).
#pragma once

#include <cstddef>

#include "model/cuda/gpu_factory.h"

namespace nrff {

bool GpuIsThere();
GpuTrainerFactory GpuUnderTest();  // null where there is none

// Pretends that the GPU has so much memory. False where that cannot be done.
bool LimitGpuMemory(size_t bytes);
// Since then; 0 where that is not known.
size_t MostGpuMemoryUsed();

}  // namespace nrff
