#include <cuda_runtime.h>

#include <stdexcept>
#include <string>

#include "render/kernels/compositing.h"
#include "render/kernels/compositing_ray.h"

namespace nrff {
namespace {

constexpr int kThreads = 128;

// One thread per ray: rays have some tens of samples, and a batch thousands of rays.
template <typename Args, void (*kRay)(const Args&, int64_t)>
__global__ void ForEachRay(Args args) {
  const int64_t r = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (r < args.n_rays) kRay(args, r);
}

template <typename Args, void (*kRay)(const Args&, int64_t)>
void Launch(const char* what, const Args& args, CudaStream stream) {
  if (args.n_rays == 0) return;
  const auto n_blocks = unsigned((args.n_rays + kThreads - 1) / kThreads);
  ForEachRay<Args, kRay><<<n_blocks, kThreads, 0, stream>>>(args);
  const cudaError_t error = cudaGetLastError();
  if (error != cudaSuccess) throw std::runtime_error(std::string(what) + ": " + cudaGetErrorString(error));
}

}  // namespace

template <typename Scalar>
void WeightsForwardCuda(const WeightsArgs<Scalar>& args, CudaStream stream) {
  Launch<WeightsArgs<Scalar>, WeightsForwardRay<Scalar>>("WeightsForward", args, stream);
}

template <typename Scalar>
void WeightsBackwardCuda(const WeightsBackwardArgs<Scalar>& args, CudaStream stream) {
  Launch<WeightsBackwardArgs<Scalar>, WeightsBackwardRay<Scalar>>("WeightsBackward", args, stream);
}

template <typename Scalar>
void AccumulateForwardCuda(const AccumulateArgs<Scalar>& args, CudaStream stream) {
  Launch<AccumulateArgs<Scalar>, AccumulateForwardRay<Scalar>>("AccumulateForward", args, stream);
}

template <typename Scalar>
void AccumulateBackwardCuda(const AccumulateBackwardArgs<Scalar>& args, CudaStream stream) {
  Launch<AccumulateBackwardArgs<Scalar>, AccumulateBackwardRay<Scalar>>("AccumulateBackward", args, stream);
}

#define NRFF_INSTANTIATE(Scalar)                                                     \
  template void WeightsForwardCuda(const WeightsArgs<Scalar>&, CudaStream);          \
  template void WeightsBackwardCuda(const WeightsBackwardArgs<Scalar>&, CudaStream); \
  template void AccumulateForwardCuda(const AccumulateArgs<Scalar>&, CudaStream);    \
  template void AccumulateBackwardCuda(const AccumulateBackwardArgs<Scalar>&, CudaStream);
NRFF_INSTANTIATE(float)
NRFF_INSTANTIATE(double)
#undef NRFF_INSTANTIATE

}  // namespace nrff
