#include <algorithm>
#include <cmath>

#include "render/kernels/compositing.h"

namespace nrff {
namespace {

// Below this, starting threads costs more than the loop.
constexpr int64_t kMinParallelRays = 512;

}  // namespace

template <typename Scalar>
void WeightsForwardCpu(const WeightsArgs<Scalar>& args) {
#pragma omp parallel for schedule(dynamic, 256) if (args.n_rays > kMinParallelRays)
  for (int64_t r = 0; r < args.n_rays; ++r) {
    const int64_t begin = args.ray_offsets[r], end = args.ray_offsets[r + 1];
    Scalar thickness = 0, transmittance = 1;
    int64_t i = begin;
    for (; i < end && transmittance >= args.stop_transmittance; ++i) {
      const Scalar tau = args.sigma[i] * args.delta[i];
      args.weights[i] = transmittance * -std::expm1(-tau);
      thickness += tau;
      transmittance = std::exp(-thickness);
    }
    args.transmittance[r] = transmittance;
    args.n_reached[r] = i - begin;
    std::fill(args.weights + i, args.weights + end, Scalar(0));
  }
}

template <typename Scalar>
void WeightsBackwardCpu(const WeightsBackwardArgs<Scalar>& args) {
#pragma omp parallel for schedule(dynamic, 256) if (args.n_rays > kMinParallelRays)
  for (int64_t r = 0; r < args.n_rays; ++r) {
    const int64_t begin = args.ray_offsets[r], reached = begin + args.n_reached[r];
    std::fill(args.dL_dsigma + reached, args.dL_dsigma + args.ray_offsets[r + 1], Scalar(0));
    Scalar transmittance = args.transmittance[r];               // T_{i+1}
    Scalar behind = args.dL_dtransmittance[r] * transmittance;  // what the samples behind and T_end contribute
    for (int64_t i = reached - 1; i >= begin; --i) {
      args.dL_dsigma[i] = args.delta[i] * (args.dL_dweights[i] * transmittance - behind);
      behind += args.dL_dweights[i] * args.weights[i];
      transmittance += args.weights[i];
    }
  }
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
  const int64_t n_channels = args.n_channels;
#pragma omp parallel for schedule(static) if (args.n_rays > kMinParallelRays)
  for (int64_t r = 0; r < args.n_rays; ++r) {
    Scalar* out = args.out + n_channels * r;
    std::fill(out, out + n_channels, Scalar(0));
    for (int64_t i = args.ray_offsets[r]; i < args.ray_offsets[r + 1]; ++i) {
      for (int64_t c = 0; c < n_channels; ++c) out[c] += args.weights[i] * args.values[n_channels * i + c];
    }
  }
}

template <typename Scalar>
void AccumulateBackwardCpu(const AccumulateBackwardArgs<Scalar>& args) {
  const int64_t n_channels = args.n_channels;
#pragma omp parallel for schedule(static) if (args.n_rays > kMinParallelRays)
  for (int64_t r = 0; r < args.n_rays; ++r) {
    const Scalar* dL_dout = args.dL_dout + n_channels * r;
    for (int64_t i = args.ray_offsets[r]; i < args.ray_offsets[r + 1]; ++i) {
      Scalar sum = 0;
      for (int64_t c = 0; c < n_channels; ++c) {
        sum += dL_dout[c] * args.values[n_channels * i + c];
        args.dL_dvalues[n_channels * i + c] = args.weights[i] * dL_dout[c];
      }
      args.dL_dweights[i] = sum;
    }
  }
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
