// Compositing of packed samples: weights from densities, sums along rays, and their gradients.
//
//   τ_i = σ_i δ_i,  α_i = −expm1(−τ_i),  T_i = exp(−Σ_{j<i} τ_j),  w_i = T_i α_i          [Han23] Eq. 1
//
// T is the exponential of a sum of τ, never a product of (1 − α), so that Σ w + T_end = 1 to rounding for any τ ≥ 0.
// Sums along a ray are in double.
// The samples of ray r are ray_offsets[r] … ray_offsets[r + 1] − 1, front to back. Parallel over rays, no atomics:
// deterministic, whatever the number of threads. Functions are defined for float and double.
//
// …Cuda takes pointers to device memory, is queued on the stream and returns at once; throws std::runtime_error when it
// cannot be queued. The CUDA twins are in libnrff_cuda (preset cuda) and share the arithmetic of one ray
// (compositing_ray.h).
#pragma once

#include <cstdint>

#include "render/kernels/device.h"

namespace nrff {

template <typename Scalar>
struct WeightsArgs {
  // inputs
  int64_t n_rays = 0;
  const int64_t* ray_offsets = nullptr;  // [n_rays + 1]
  const Scalar* sigma = nullptr;         // [n_samples] ≥ 0
  const Scalar* delta = nullptr;         // [n_samples] ≥ 0
  // A ray ends before the first sample with T < stop_transmittance: that and later weights are exactly 0, without
  // gradient. Since w ≤ T, no weight above stop_transmittance is lost. 0: never.
  Scalar stop_transmittance = 0;
  // outputs, overwritten
  Scalar* weights = nullptr;        // [n_samples]
  Scalar* transmittance = nullptr;  // [n_rays] T_end, behind the last sample that was reached
  int64_t* n_reached = nullptr;     // [n_rays] samples before the stop
};

template <typename Scalar>
void WeightsForwardCpu(const WeightsArgs<Scalar>& args);
template <typename Scalar>
void WeightsForwardCuda(const WeightsArgs<Scalar>& args, CudaStream stream);

// dL/dτ_i = dL/dw_i T_{i+1} − Σ_{j>i} dL/dw_j w_j − dL/dT_end T_end, and dL/dσ_i = δ_i dL/dτ_i. T_{i+1} is rebuilt
// from the back as T_end + Σ_{j>i} w_j, a sum of positive terms, so it keeps its relative precision.
template <typename Scalar>
struct WeightsBackwardArgs {
  // inputs
  int64_t n_rays = 0;
  const int64_t* ray_offsets = nullptr;       // [n_rays + 1]
  const Scalar* delta = nullptr;              // [n_samples]
  const Scalar* weights = nullptr;            // [n_samples] as WeightsForwardCpu left them, like the next two
  const Scalar* transmittance = nullptr;      // [n_rays]
  const int64_t* n_reached = nullptr;         // [n_rays]
  const Scalar* dL_dweights = nullptr;        // [n_samples]
  const Scalar* dL_dtransmittance = nullptr;  // [n_rays]
  // output, overwritten
  Scalar* dL_dsigma = nullptr;  // [n_samples]
};

template <typename Scalar>
void WeightsBackwardCpu(const WeightsBackwardArgs<Scalar>& args);
template <typename Scalar>
void WeightsBackwardCuda(const WeightsBackwardArgs<Scalar>& args, CudaStream stream);

// Samples with weight > threshold, in order.
template <typename Scalar>
struct SelectArgs {
  int64_t n_rays = 0;
  const int64_t* ray_offsets = nullptr;  // [n_rays + 1]
  const Scalar* weights = nullptr;       // [n_samples]
  Scalar threshold = 0;
};

// selected_offsets [n_rays + 1], overwritten: as ray_offsets, for the selected samples. Returns their number.
template <typename Scalar>
int64_t CountSelectedCpu(const SelectArgs<Scalar>& args, int64_t* selected_offsets);

// indices [n_selected], overwritten: positions in the packed samples.
template <typename Scalar>
void FillSelectedCpu(const SelectArgs<Scalar>& args, const int64_t* selected_offsets, int64_t* indices);

// out_{r,c} = Σ_{i of ray r} w_i v_{i,c}
template <typename Scalar>
struct AccumulateArgs {
  // inputs
  int64_t n_rays = 0;
  int64_t n_channels = 0;
  const int64_t* ray_offsets = nullptr;  // [n_rays + 1]
  const Scalar* weights = nullptr;       // [n_samples]
  const Scalar* values = nullptr;        // [n_samples, n_channels]
  // output, overwritten
  Scalar* out = nullptr;  // [n_rays, n_channels]
};

template <typename Scalar>
void AccumulateForwardCpu(const AccumulateArgs<Scalar>& args);
template <typename Scalar>
void AccumulateForwardCuda(const AccumulateArgs<Scalar>& args, CudaStream stream);

template <typename Scalar>
struct AccumulateBackwardArgs {
  // inputs
  int64_t n_rays = 0;
  int64_t n_channels = 0;
  const int64_t* ray_offsets = nullptr;  // [n_rays + 1]
  const Scalar* weights = nullptr;       // [n_samples]
  const Scalar* values = nullptr;        // [n_samples, n_channels]
  const Scalar* dL_dout = nullptr;       // [n_rays, n_channels]
  // outputs, overwritten
  Scalar* dL_dweights = nullptr;  // [n_samples]
  Scalar* dL_dvalues = nullptr;   // [n_samples, n_channels]
};

template <typename Scalar>
void AccumulateBackwardCpu(const AccumulateBackwardArgs<Scalar>& args);
template <typename Scalar>
void AccumulateBackwardCuda(const AccumulateBackwardArgs<Scalar>& args, CudaStream stream);

}  // namespace nrff
