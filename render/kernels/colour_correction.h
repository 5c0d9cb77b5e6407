// What a photo's exposure and white balance make of the light that the field sends, shared by the CPU and CUDA twins.
//
// A view's correction D [3][4] says how its colours differ from the scene's. It acts on the field's light F = Σ w c
// alone, with the constant in proportion to the ray's opacity 1 − T, and not on the background that lies behind, which
// is given:
//   C = F + D (F, 1 − T) + T · background
#pragma once

#include "render/kernels/device.h"

namespace nrff {

inline constexpr int kCorrectionRows = 3, kCorrectionColumns = 4;
inline constexpr int kCorrectionParameters = kCorrectionRows * kCorrectionColumns;

// correction [12], or null for none; light, colour [3].
template <typename Scalar>
NRFF_HOST_DEVICE inline void CorrectedColour(const Scalar* correction, const Scalar* light, Scalar transmittance,
                                             Scalar background, Scalar* colour) {
  for (int c = 0; c < kCorrectionRows; ++c) {
    colour[c] = light[c] + transmittance * background;
    if (correction == nullptr) continue;
    const Scalar* row = correction + kCorrectionColumns * c;
    colour[c] += row[0] * light[0] + row[1] * light[1] + row[2] * light[2] + row[3] * (1 - transmittance);
  }
}

// From dL/dC: dL/dF [3], returns dL/dT; add(i, dL/dD[i]) is called for each of the correction's parameters.
template <typename Scalar, typename Add>
NRFF_HOST_DEVICE inline Scalar CorrectedColourBackward(const Scalar* correction, const Scalar* light,
                                                       Scalar transmittance, Scalar background, const Scalar* d_colour,
                                                       Scalar* d_light, const Add& add) {
  Scalar d_transmittance = 0;
  for (int c = 0; c < kCorrectionRows; ++c) {
    d_light[c] = d_colour[c];
    d_transmittance += d_colour[c] * background;
  }
  if (correction == nullptr) return d_transmittance;
  for (int c = 0; c < kCorrectionRows; ++c) {
    const Scalar* row = correction + kCorrectionColumns * c;
    for (int j = 0; j < 3; ++j) {
      d_light[j] += d_colour[c] * row[j];
      add(kCorrectionColumns * c + j, d_colour[c] * light[j]);
    }
    d_transmittance -= d_colour[c] * row[3];
    add(kCorrectionColumns * c + 3, d_colour[c] * (1 - transmittance));
  }
  return d_transmittance;
}

}  // namespace nrff
