// A picture of where a rendered image is wrong.
//
// Per pixel the root mean square of the difference over RGB (image values in [0, 1]), linearly from 0 (black) to
// kErrorMapRange and beyond (pale yellow) in the colours of "inferno" [Smith15], whose lightness grows evenly, so that
// equal steps of error look equal and it can be read in grey. The range is fixed so that views, scenes and runs can be
// compared by eye.
#pragma once

#include <cstdint>
#include <vector>

#include "eval/metrics.h"

namespace nrff {

inline constexpr double kErrorMapRange = 0.2;  // of the value range [0, 1]

// [height, width, 3] uint8. Both images have the same size.
std::vector<uint8_t> ErrorMap(const RgbImage& truth, const RgbImage& rendered);

}  // namespace nrff
