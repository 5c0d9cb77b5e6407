// The twin of the compositing kernels that compositing_stability.cc is linked with: compositing_twin_cpu.cc's or
// compositing_twin_cuda.cc's. All pointers are the host's.
#pragma once

#include "render/kernels/compositing.h"

namespace nrff::stability {

extern const char* const kTwinSuffix;      // of the part's name in the table
extern const double kTwinExponentialUlps;  // what exp and expm1 are off by, at the most
bool TwinAvailable();

// For float and double.
template <typename Scalar>
void TwinForward(const WeightsArgs<Scalar>& args);
template <typename Scalar>
void TwinBackward(const WeightsBackwardArgs<Scalar>& args);

}  // namespace nrff::stability
