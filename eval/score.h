// The figures of pairs of images, and their means, as metrics.json states them (evaluate.h has its layout).
#pragma once

#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <vector>

#include "eval/colour_fit.h"
#include "eval/lpips.h"
#include "eval/metrics.h"
#include "pipeline/json.h"
#include "pipeline/needs.h"
#include "pipeline/scene.h"

namespace nrff {

// What LPIPS is measured with.
struct LpipsChoice {
  std::unique_ptr<LpipsNetwork> network;  // null: it is left out
  Decision decision;
};

// network: a file, or needs::kNoLpips. Throws InputError when the file is not LPIPS as published.
LpipsChoice ChooseLpips(const std::string& network);

struct ScoredPair {
  RgbImage truth, rendered;
  std::optional<Mask> mask;            // pixels that PSNR and SSIM are of; the others are the same in both (Hide)
  std::optional<Mask> foreground;      // pixels of the subject, where alpha says which they are
  std::optional<double> psnr_whole{};  // dB, before the mask hid anything
};

struct Score {
  double mean_squared_error = 0;  // over the mask
  std::optional<double> ssim;     // none when no window fits
  std::optional<double> lpips;    // none when the image is too small, or without a network
  double psnr_quantised = 0;      // dB, both rounded to 8 bits; infinite when equal, as the others
  std::optional<double> psnr_foreground, psnr_whole;
  std::optional<ColourFit> colour_fit;
};

// LPIPS for many threads, one at a time: OpenCV uses all cores for each.
class SharedLpips {
 public:
  explicit SharedLpips(LpipsNetwork* network) : network_(network) {}
  std::optional<double> Distance(const RgbImage& truth, const RgbImage& rendered);

 private:
  LpipsNetwork* network_;
  std::mutex mutex_;
};

// Gives the pair the mask: keeps the PSNR of the whole images, then shows the background outside the mask in both.
void Hide(Mask mask, Background background, ScoredPair& pair);

Score ScoreImages(const ScoredPair& pair, SharedLpips& lpips);

// Scores n images, `n_threads` at a time, with progress: score(i) for i in [0, n). The first exception is thrown again.
std::vector<Score> ScoreAll(size_t n, int n_threads, const std::function<Score(size_t)>& score);

// An image's {psnr, ssim, lpips, psnr_quantised, psnr_foreground, psnr_whole, psnr_right_half,
// psnr_colour_fitted, and reasons}.
Json ScoreToJson(const Score& score, bool with_lpips);

// {psnr, ssim, lpips, n_images, variants, and reasons}. `nothing`: why there is no image, where there is none.
Json MeanScores(const std::vector<Score>& scores, const LpipsChoice& lpips, const std::string& nothing);

// What does not depend on where the images come from: {range, ssim, mean, variants, error_map, lpips}.
Json MetricsProtocol(const LpipsNetwork* lpips);

}  // namespace nrff
