// What scoring costs, and what it would lose on smaller images: the figures of a scene's held-out views at their own
// size and shrunk by area averaging, with the seconds that each takes.
#pragma once

#include <filesystem>

#include "eval/held_out_pairs.h"
#include "eval/score.h"
#include "pipeline/json.h"

namespace nrff {

// Mean of blocks of factor × factor pixels; what is left over at the right and the bottom is cut off. Factor ≥ 1, at
// most the shorter side.
RgbImage Shrunk(const RgbImage& image, int factor);

// [{factor, width, height: the largest, n_images, psnr, ssim, lpips: means or null,
//   seconds {psnr, ssim, lpips}: an image, one thread but for LPIPS; chosen: the own size}], of up to kMostPairs pairs
// spread over their order, from the smallest images to the largest. Shows progress.
Json ScoringWorkPrecision(const HeldOutPairs& pairs, LpipsNetwork* lpips);

inline constexpr size_t kMostPairs = 8;

}  // namespace nrff
