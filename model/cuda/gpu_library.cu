// What libnrff_cuda.so gives.

#include <string>

#include "model/cuda/gpu_factory.h"
#include "model/cuda/gpu_trainer_program.h"

namespace nrff {
namespace {

constexpr int kLeastComputeCapability = 80;

std::string DescribeGpu() {
  const device::DeviceFacts facts = device::GetDeviceFacts();
  if (facts.compute_capability < kLeastComputeCapability) {
    throw device::DeviceError("a GPU (" + facts.name + ") of compute capability " +
                              std::to_string(facts.compute_capability / 10) + "." +
                              std::to_string(facts.compute_capability % 10) + ", where 8.0 is needed");
  }
  return facts.name + ", " + std::to_string(facts.memory_bytes >> 30) + " GiB";
}

std::unique_ptr<GpuTrainer> MakeTrainer(const GpuModel& model, const GpuScene& scene, int occupancy_resolution,
                                        const GpuTrainerOptions& options) {
  return device::MakeGpuTrainerProgram(model, scene, occupancy_resolution, options);
}

}  // namespace
}  // namespace nrff

extern "C" const nrff::GpuLibrary* nrff_gpu_library() {
  static const nrff::GpuLibrary library{NRFF_VERSION, nrff::DescribeGpu, nrff::MakeTrainer};
  return &library;
}
