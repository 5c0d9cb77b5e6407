// Scores rendered held-out views against the photos, or any folder of images against another.
//
// Of a scene, what is compared is exactly what lies on disk: the photo as the pose stage packed it (undistorted,
// area-averaged to the scene's size, composited on the scene's background where its alpha shows it, rounded to 8 bits)
// and the rendered view, of 8 or 16 bits. Of masked views, the pixels that count. Anyone can recompute the figures from
// the two files.
//
// metrics.json (schema 1):
//   protocol  how the figures were made: range, bits {truth, rendered} and quantised (both of 8 bits), background,
//             ssim {window, sigma, k1, k2, border, channels}, split (the rule), resize (the filter), masked, exposures
//             (which views were rendered in), images (which, by name), mean, variants {what each is}, error_map
//             {measure, range}, lpips {network, version, hash} where it was measured
//   metrics   psnr (dB, mean over images), ssim, lpips (means over images), n_images;
//             variants {psnr_pooled, psnr_quantised, psnr_foreground, psnr_whole, psnr_right_half,
//             psnr_colour_fitted (colour_fit.h)}, as other projects print them, null where there is none; a figure that
//             cannot be given is null and has its <figure>_reason; n_identical when some images equal their photo:
//             their PSNR is infinite, which JSON cannot say
//   images    [{id, name, width, height, psnr, ssim, lpips, psnr_quantised, truth, mask, rendered, error}]; paths
//   relative to
//             metrics.json. psnr null + "identical": true for an image that equals its photo; it is left out of the
//             mean PSNR. ssim null + "ssim_reason" for an image smaller than the window; it is left out of the mean
//             SSIM. lpips and "lpips_reason" alike, for one that is too small for the network. psnr_foreground where
//             the photo has alpha.
#pragma once

#include <filesystem>

#include "eval/score.h"
#include "pipeline/manifest.h"
#include "pipeline/scene.h"

namespace nrff {

// Reads the artifacts `scene_dir` (pose) and `renders_dir` (render), writes the artifact `out_dir` (eval) with
// `n_threads` images at a time. Without a held-out view the figures are null with the reason. Throws InputError when a
// held-out view was not rendered or has another size than its photo.
void Evaluate(const std::filesystem::path& scene_dir, const std::filesystem::path& renders_dir,
              const std::filesystem::path& out_dir, const Params& params, const LpipsChoice& lpips, int n_threads);

// Folders of images, paired by file name without extension.
struct Folders {
  std::filesystem::path truth, rendered;
  std::filesystem::path masks;                 // grey, a half and more counts; empty: all pixels do
  Background background = Background::kWhite;  // behind alpha and, in both, outside masks
};

// Scores every image of `rendered` and writes the artifact `out_dir` (eval) without its truth/. Nothing is resized,
// nothing rounded. Throws InputError when an image has no counterpart or another size.
void Compare(const Folders& folders, const std::filesystem::path& out_dir, const Params& params,
             const LpipsChoice& lpips, int n_threads);

}  // namespace nrff
