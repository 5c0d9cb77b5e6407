// Scores rendered held-out views against the photos.
//
// What is compared is exactly what lies on disk as 8-bit PNG: the photo as the pose stage packed it (undistorted,
// area-averaged to the scene's size, composited on the scene's background where it has alpha, rounded to 8 bits) and
// the rendered view. Anyone can recompute the figures from the two files.
//
// metrics.json (schema 1):
//   protocol  how the figures were made: range, quantised, background, ssim {window, sigma, k1, k2, border, channels},
//             split (the rule), resize (the filter), images (which, by photo name), mean, error_map {measure, range}
//             lpips {network, version, hash} where it was measured
//   metrics   psnr (dB, mean over images), ssim, lpips (means over images), n_images;
//             a figure that cannot be given is null and has its <figure>_reason;
//             n_identical when some images equal their photo: their PSNR is infinite, which JSON cannot say
//   images    [{id, name, width, height, psnr, ssim, lpips, truth, rendered, error}]; paths relative to metrics.json.
//             psnr null + "identical": true for an image that equals its photo; it is left out of the mean PSNR.
//             ssim null + "ssim_reason" for an image smaller than the window; it is left out of the mean SSIM. lpips
//             and "lpips_reason" alike, for one that is too small for the network.
#pragma once

#include <filesystem>
#include <memory>
#include <string>

#include "eval/lpips.h"
#include "pipeline/manifest.h"
#include "pipeline/needs.h"

namespace nrff {

// What LPIPS is measured with.
struct LpipsChoice {
  std::unique_ptr<LpipsNetwork> network;  // null: it is left out
  Decision decision;
};

// network: a file, or needs::kNoLpips. Throws InputError when the file is not LPIPS as published.
LpipsChoice ChooseLpips(const std::string& network);

// Reads the artifacts `scene_dir` (pose) and `renders_dir` (render), writes the artifact `out_dir` (eval) with
// `n_threads` images at a time. Without a held-out view the figures are null with the reason. Throws InputError when a
// held-out view was not rendered or has another size than its photo.
void Evaluate(const std::filesystem::path& scene_dir, const std::filesystem::path& renders_dir,
              const std::filesystem::path& out_dir, const Params& params, const LpipsChoice& lpips, int n_threads);

}  // namespace nrff
