// Exposure and white balance of a photo that no training has seen, taken out of a comparison: the rendered image's
// colours are fitted to the photo's by the affine map that training gives each of its own views, on the left half of
// the image, and the figures are of the right half. That is how NeRF in the Wild [MartinBrualla21] scores held-out
// views.
#pragma once

#include <optional>

#include "eval/metrics.h"

namespace nrff {

struct ColourFit {
  double psnr_before = 0, psnr_after = 0;  // dB, of the right half; infinite where it equals the photo's
};

// The map is fitted in least squares over the pixels x < width/2 that `mask` (nullptr: all) counts, and drawn to none
// as far as the fit leaves it open. Nothing where one of the halves has no pixel that counts.
std::optional<ColourFit> FitColours(const RgbImage& truth, const RgbImage& rendered, const Mask* mask = nullptr);

}  // namespace nrff
