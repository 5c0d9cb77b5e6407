// The CUDA half of the model, which is a shared library of its own and opened only where a GPU is found.
#pragma once

#include <string>

#include "model/cuda/gpu_factory.h"
#include "pipeline/needs.h"

namespace nrff {

struct Device {
  Decision decision;
  GpuTrainerFactory gpu;  // null: the CPU
};

// `asked` as given by --device: "auto", "cpu" or "cuda". Throws ResourceError saying why when CUDA is asked for and
// cannot be had.
Device ChooseDevice(const std::string& asked);

}  // namespace nrff
