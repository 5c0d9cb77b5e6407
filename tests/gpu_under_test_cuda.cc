#include "model/cuda/gpu_library.h"
#include "pipeline/error.h"
#include "tests/gpu_under_test.h"

namespace nrff {

GpuTrainerFactory GpuUnderTest() {
  try {
    return ChooseDevice("cuda").gpu;
  } catch (const Error&) {
    return {};
  }
}
bool GpuIsThere() { return GpuUnderTest() != nullptr; }
bool LimitGpuMemory(size_t /*bytes*/) { return false; }
size_t MostGpuMemoryUsed() { return 0; }

}  // namespace nrff
