#include "tests/device_array.h"
#include "tests/stability/compositing_twin.h"

namespace nrff::stability {

const char* const kTwinSuffix = ", CUDA";
const double kTwinExponentialUlps = 2;  // CUDA C++ Programming Guide, mathematical functions: expf 2, expm1f 1
bool TwinAvailable() { return HasGpu(); }

template <typename Scalar>
void TwinForward(const WeightsArgs<Scalar>& args) {
  const auto n_rays = size_t(args.n_rays), n = size_t(args.ray_offsets[args.n_rays]);
  const DeviceArray<int64_t> offsets(args.ray_offsets, n_rays + 1), n_reached(args.n_reached, n_rays);
  const DeviceArray<Scalar> sigma(args.sigma, n), delta(args.delta, n), weights(args.weights, n),
      transmittance(args.transmittance, n_rays);
  WeightsForwardCuda(WeightsArgs<Scalar>{.n_rays = args.n_rays,
                                         .ray_offsets = offsets.get(),
                                         .sigma = sigma.get(),
                                         .delta = delta.get(),
                                         .stop_transmittance = args.stop_transmittance,
                                         .weights = weights.get(),
                                         .transmittance = transmittance.get(),
                                         .n_reached = n_reached.get()},
                     nullptr);
  CheckCuda(cudaDeviceSynchronize());
  weights.CopyTo(args.weights);
  transmittance.CopyTo(args.transmittance);
  n_reached.CopyTo(args.n_reached);
}

template <typename Scalar>
void TwinBackward(const WeightsBackwardArgs<Scalar>& args) {
  const auto n_rays = size_t(args.n_rays), n = size_t(args.ray_offsets[args.n_rays]);
  const DeviceArray<int64_t> offsets(args.ray_offsets, n_rays + 1), n_reached(args.n_reached, n_rays);
  const DeviceArray<Scalar> delta(args.delta, n), weights(args.weights, n), transmittance(args.transmittance, n_rays),
      dL_dweights(args.dL_dweights, n), dL_dtransmittance(args.dL_dtransmittance, n_rays), dL_dsigma(args.dL_dsigma, n);
  WeightsBackwardCuda(WeightsBackwardArgs<Scalar>{.n_rays = args.n_rays,
                                                  .ray_offsets = offsets.get(),
                                                  .delta = delta.get(),
                                                  .weights = weights.get(),
                                                  .transmittance = transmittance.get(),
                                                  .n_reached = n_reached.get(),
                                                  .dL_dweights = dL_dweights.get(),
                                                  .dL_dtransmittance = dL_dtransmittance.get(),
                                                  .dL_dsigma = dL_dsigma.get()},
                      nullptr);
  CheckCuda(cudaDeviceSynchronize());
  dL_dsigma.CopyTo(args.dL_dsigma);
}

template void TwinForward(const WeightsArgs<float>&);
template void TwinForward(const WeightsArgs<double>&);
template void TwinBackward(const WeightsBackwardArgs<float>&);
template void TwinBackward(const WeightsBackwardArgs<double>&);

}  // namespace nrff::stability
