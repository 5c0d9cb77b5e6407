#include "render/compute.h"

#include <ATen/Parallel.h>
#include <omp.h>

#include <filesystem>

#include "pipeline/error.h"

namespace nrff {
namespace {

constexpr bool kHasCudaPath = false;

int CountGpus() {
  int n = 0;
  std::error_code absent;
  while (std::filesystem::exists("/dev/nvidia" + std::to_string(n), absent)) ++n;
  return n;
}

}  // namespace

int SetThreads(int n_threads) {
  if (n_threads <= 0) n_threads = omp_get_num_procs();
  omp_set_num_threads(n_threads);
  at::set_num_threads(n_threads);
  return n_threads;
}

Decision ChooseDevice(const std::string& device) {
  if (device == "cuda" && !kHasCudaPath) {
    throw ResourceError(
        "--device cuda was asked for, but this version trains and renders on the CPU only; use --device auto or cpu");
  }
  return needs::Cuda(kHasCudaPath, CountGpus());
}

}  // namespace nrff
