// The arithmetic of compositing.h for one ray, shared by the CPU and CUDA twins.
#pragma once

#include <cmath>

#include "render/kernels/compositing.h"

namespace nrff {

template <typename Scalar>
NRFF_HOST_DEVICE void WeightsForwardRay(const WeightsArgs<Scalar>& args, int64_t r) {
  const int64_t begin = args.ray_offsets[r], end = args.ray_offsets[r + 1];
  double thickness = 0;  // summed in double, as 65,536 samples in float would cost four digits of it
  Scalar transmittance = 1;
  int64_t i = begin;
  for (; i < end && transmittance >= args.stop_transmittance; ++i) {
    const Scalar tau = args.sigma[i] * args.delta[i];
    args.weights[i] = transmittance * -std::expm1(-tau);
    thickness += tau;
    transmittance = std::exp(static_cast<Scalar>(-thickness));
  }
  args.transmittance[r] = transmittance;
  args.n_reached[r] = i - begin;
  for (; i < end; ++i) args.weights[i] = 0;
}

template <typename Scalar>
NRFF_HOST_DEVICE void WeightsBackwardRay(const WeightsBackwardArgs<Scalar>& args, int64_t r) {
  const int64_t begin = args.ray_offsets[r], reached = begin + args.n_reached[r];
  for (int64_t i = reached; i < args.ray_offsets[r + 1]; ++i) args.dL_dsigma[i] = 0;
  double transmittance = args.transmittance[r];               // T_{i+1}
  double behind = args.dL_dtransmittance[r] * transmittance;  // what the samples behind and T_end contribute
  for (int64_t i = reached - 1; i >= begin; --i) {
    args.dL_dsigma[i] = static_cast<Scalar>(args.delta[i] * (args.dL_dweights[i] * transmittance - behind));
    behind += static_cast<double>(args.dL_dweights[i]) * args.weights[i];
    transmittance += args.weights[i];
  }
}

template <typename Scalar>
NRFF_HOST_DEVICE void AccumulateForwardRay(const AccumulateArgs<Scalar>& args, int64_t r) {
  const int64_t n_channels = args.n_channels;
  Scalar* out = args.out + n_channels * r;
  for (int64_t c = 0; c < n_channels; ++c) out[c] = 0;
  for (int64_t i = args.ray_offsets[r]; i < args.ray_offsets[r + 1]; ++i) {
    for (int64_t c = 0; c < n_channels; ++c) out[c] += args.weights[i] * args.values[n_channels * i + c];
  }
}

template <typename Scalar>
NRFF_HOST_DEVICE void AccumulateBackwardRay(const AccumulateBackwardArgs<Scalar>& args, int64_t r) {
  const int64_t n_channels = args.n_channels;
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

}  // namespace nrff
