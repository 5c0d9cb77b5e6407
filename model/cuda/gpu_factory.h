// What libnrff_cuda.so gives, without torch.
#pragma once

#include <functional>
#include <memory>
#include <string>

#include "model/cuda/gpu_trainer.h"

namespace nrff {

// Throws device::DeviceError, which names the memory that is missing where that is the reason.
using GpuTrainerFactory = std::function<std::unique_ptr<GpuTrainer>(
    const GpuModel& model, const GpuScene& scene, int occupancy_resolution, const GpuTrainerOptions& options)>;

// By the library's one symbol, kGpuLibrarySymbol: a function without arguments that returns it.
struct GpuLibrary {
  std::string version;  // of nrff; the library must be of the same
  // "NVIDIA H100, 80 GB". Throws device::DeviceError where no GPU can be used.
  std::string (*describe_gpu)() = nullptr;
  std::unique_ptr<GpuTrainer> (*make_trainer)(const GpuModel& model, const GpuScene& scene, int occupancy_resolution,
                                              const GpuTrainerOptions& options) = nullptr;
};
inline constexpr char kGpuLibrarySymbol[] = "nrff_gpu_library";
inline constexpr char kGpuLibraryFile[] = "libnrff_cuda.so";

}  // namespace nrff
