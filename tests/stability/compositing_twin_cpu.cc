#include "tests/stability/compositing_twin.h"

namespace nrff::stability {

const char* const kTwinSuffix = "";
const double kTwinExponentialUlps = 1;
bool TwinAvailable() { return true; }

template <typename Scalar>
void TwinForward(const WeightsArgs<Scalar>& args) {
  WeightsForwardCpu(args);
}
template <typename Scalar>
void TwinBackward(const WeightsBackwardArgs<Scalar>& args) {
  WeightsBackwardCpu(args);
}
template void TwinForward(const WeightsArgs<float>&);
template void TwinForward(const WeightsArgs<double>&);
template void TwinBackward(const WeightsBackwardArgs<float>&);
template void TwinBackward(const WeightsBackwardArgs<double>&);

}  // namespace nrff::stability
