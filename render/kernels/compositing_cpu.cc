#include "render/kernels/compositing.h"
#include "render/kernels/compositing_ray.h"

namespace nrff {
namespace {

// Below this, starting threads costs more than the loop.
constexpr int64_t kMinParallelRays = 512;

}  // namespace

template <typename Scalar>
void WeightsForwardCpu(const WeightsArgs<Scalar>& args) {
#pragma omp parallel for schedule(dynamic, 256) if (args.n_rays > kMinParallelRays)
  for (int64_t r = 0; r < args.n_rays; ++r) WeightsForwardRay(args, r);
}

template <typename Scalar>
void WeightsBackwardCpu(const WeightsBackwardArgs<Scalar>& args) {
#pragma omp parallel for schedule(dynamic, 256) if (args.n_rays > kMinParallelRays)
  for (int64_t r = 0; r < args.n_rays; ++r) WeightsBackwardRay(args, r);
}

template <typename Scalar>
int64_t CountSelectedCpu(const SelectArgs<Scalar>& args, int64_t* selected_offsets) {
  selected_offsets[0] = 0;
  for (int64_t r = 0; r < args.n_rays; ++r) {
    int64_t n = 0;
    for (int64_t i = args.ray_offsets[r]; i < args.ray_offsets[r + 1]; ++i) n += args.weights[i] > args.threshold;
    selected_offsets[r + 1] = selected_offsets[r] + n;
  }
  return selected_offsets[args.n_rays];
}

template <typename Scalar>
void FillSelectedCpu(const SelectArgs<Scalar>& args, const int64_t* selected_offsets, int64_t* indices) {
#pragma omp parallel for schedule(static) if (args.n_rays > kMinParallelRays)
  for (int64_t r = 0; r < args.n_rays; ++r) {
    int64_t next = selected_offsets[r];
    for (int64_t i = args.ray_offsets[r]; i < args.ray_offsets[r + 1]; ++i) {
      if (args.weights[i] > args.threshold) indices[next++] = i;
    }
  }
}

template <typename Scalar>
void AccumulateForwardCpu(const AccumulateArgs<Scalar>& args) {
#pragma omp parallel for schedule(static) if (args.n_rays > kMinParallelRays)
  for (int64_t r = 0; r < args.n_rays; ++r) AccumulateForwardRay(args, r);
}

template <typename Scalar>
void AccumulateBackwardCpu(const AccumulateBackwardArgs<Scalar>& args) {
#pragma omp parallel for schedule(static) if (args.n_rays > kMinParallelRays)
  for (int64_t r = 0; r < args.n_rays; ++r) AccumulateBackwardRay(args, r);
}

#define NRFF_INSTANTIATE(Scalar)                                                      \
  template void WeightsForwardCpu(const WeightsArgs<Scalar>&);                        \
  template void WeightsBackwardCpu(const WeightsBackwardArgs<Scalar>&);               \
  template int64_t CountSelectedCpu(const SelectArgs<Scalar>&, int64_t*);             \
  template void FillSelectedCpu(const SelectArgs<Scalar>&, const int64_t*, int64_t*); \
  template void AccumulateForwardCpu(const AccumulateArgs<Scalar>&);                  \
  template void AccumulateBackwardCpu(const AccumulateBackwardArgs<Scalar>&);
NRFF_INSTANTIATE(float)
NRFF_INSTANTIATE(double)
#undef NRFF_INSTANTIATE

}  // namespace nrff
