#include "model/cuda/gpu_trainer_program.h"
#include "tests/emulation/device_emulation.h"
#include "tests/gpu_under_test.h"

namespace nrff {

GpuTrainerFactory GpuUnderTest() { return device::MakeGpuTrainerProgram; }
bool GpuIsThere() { return true; }
bool LimitGpuMemory(size_t bytes) {
  device::SetEmulatedMemory(bytes);
  return true;
}
size_t MostGpuMemoryUsed() { return device::MostEmulatedMemoryUsed(); }

}  // namespace nrff
