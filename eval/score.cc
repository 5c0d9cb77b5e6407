#include "eval/score.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <future>
#include <utility>

#include "eval/error_map.h"
#include "eval/image_file.h"
#include "pipeline/progress.h"

namespace nrff {
namespace {

RgbImage Quantised(const RgbImage& image) {
  RgbImage rounded{image.width, image.height, {}};
  rounded.rgb.reserve(image.rgb.size());
  for (const uint8_t value : ToEightBits(image)) rounded.rgb.push_back(value / 255.0);
  return rounded;
}

// Runs work(i) for i in [0, n) on `n_threads` threads; the first exception is thrown again here.
template <typename Work>
void ForEachIndex(size_t n, int n_threads, const Work& work) {
  std::atomic<size_t> next{0};
  std::vector<std::future<void>> workers;
  workers.reserve(n_threads);
  for (int t = 0; t < n_threads; ++t) {
    workers.push_back(std::async(std::launch::async, [&] {
      try {
        for (size_t i = next++; i < n; i = next++) work(i);
      } catch (...) {
        next = n;
        throw;
      }
    }));
  }
  for (auto& worker : workers) worker.wait();
  for (auto& worker : workers) worker.get();
}

// Mean of the figures that there are and that are finite.
class Mean {
 public:
  void Add(std::optional<double> value) {
    if (value && std::isfinite(*value)) sum_ += *value, ++n_;
  }
  bool empty() const { return n_ == 0; }
  int n() const { return n_; }
  Json ToJson() const { return n_ == 0 ? Json() : Json(sum_ / n_); }

 private:
  double sum_ = 0;
  int n_ = 0;
};

// JSON has no infinity.
Json Finite(double value) { return std::isfinite(value) ? Json(value) : Json(); }

}  // namespace

LpipsChoice ChooseLpips(const std::string& network) {
  LpipsChoice choice{nullptr, needs::Lpips(network)};
  if (!choice.decision.needed) return choice;
  choice.network = std::make_unique<LpipsNetwork>(network);
  choice.network->RequirePublished();
  return choice;
}

std::optional<double> SharedLpips::Distance(const RgbImage& truth, const RgbImage& rendered) {
  if (network_ == nullptr) return std::nullopt;
  const std::lock_guard lock(mutex_);
  return network_->Distance(truth, rendered);
}

void Hide(Mask mask, Background background, ScoredPair& pair) {
  pair.psnr_whole = Psnr(pair.truth, pair.rendered);
  for (RgbImage* image : {&pair.truth, &pair.rendered}) {
    for (size_t i = 0; i < image->rgb.size(); ++i) {
      if (mask[i / 3] == 0) image->rgb[i] = background == Background::kWhite ? 1 : 0;
    }
  }
  pair.mask = std::move(mask);
}

Score ScoreImages(const ScoredPair& pair, SharedLpips& lpips) {
  const Mask* mask = pair.mask ? &*pair.mask : nullptr;
  Score score;
  score.mean_squared_error = MeanSquaredError(pair.truth, pair.rendered, mask);
  score.ssim = Ssim(pair.truth, pair.rendered, mask);
  score.lpips = lpips.Distance(pair.truth, pair.rendered);
  score.psnr_quantised = Psnr(Quantised(pair.truth), Quantised(pair.rendered), mask);
  score.psnr_whole = pair.psnr_whole;
  score.colour_fit = FitColours(pair.truth, pair.rendered, mask);
  if (pair.foreground) {
    Mask subject = *pair.foreground;
    for (size_t i = 0; mask != nullptr && i < subject.size(); ++i) subject[i] = subject[i] != 0 && (*mask)[i] != 0;
    const bool any = std::any_of(subject.begin(), subject.end(), [](uint8_t inside) { return inside != 0; });
    if (any) score.psnr_foreground = Psnr(pair.truth, pair.rendered, &subject);
  }
  return score;
}

std::vector<Score> ScoreAll(size_t n, int n_threads, const std::function<Score(size_t)>& score) {
  std::vector<Score> scores(n);
  Progress progress("scoring", double(n), "views");
  std::mutex progress_mutex;
  int n_done = 0;
  ForEachIndex(n, n_threads, [&](size_t i) {
    scores[i] = score(i);
    const std::lock_guard lock(progress_mutex);
    progress.Update(++n_done);
  });
  progress.Done();
  return scores;
}

Json ScoreToJson(const Score& score, bool with_lpips) {
  const double psnr = PsnrOf(score.mean_squared_error);
  Json json = {{"psnr", Finite(psnr)}, {"ssim", nullptr}, {"lpips", nullptr}};
  if (std::isinf(psnr)) json["identical"] = true;
  if (score.ssim) {
    json["ssim"] = *score.ssim;
  } else {
    json["ssim_reason"] = "no window of " + std::to_string(kSsimWindow) + " px lies in the image";
  }
  if (score.lpips) {
    json["lpips"] = *score.lpips;
  } else if (with_lpips) {
    json["lpips_reason"] = "the image is smaller than " + std::to_string(kLpipsSmallest) + " px";
  }
  json["psnr_quantised"] = Finite(score.psnr_quantised);
  if (score.psnr_foreground) json["psnr_foreground"] = Finite(*score.psnr_foreground);
  if (score.psnr_whole) json["psnr_whole"] = Finite(*score.psnr_whole);
  if (score.colour_fit) {
    json["psnr_right_half"] = Finite(score.colour_fit->psnr_before);
    json["psnr_colour_fitted"] = Finite(score.colour_fit->psnr_after);
  }
  return json;
}

Json MeanScores(const std::vector<Score>& scores, const LpipsChoice& lpips, const std::string& nothing) {
  Mean psnr, ssim, distance, quantised, foreground, whole, right_half, colour_fitted, squared_error;
  for (const Score& score : scores) {
    psnr.Add(PsnrOf(score.mean_squared_error));
    ssim.Add(score.ssim);
    distance.Add(score.lpips);
    quantised.Add(score.psnr_quantised);
    foreground.Add(score.psnr_foreground);
    whole.Add(score.psnr_whole);
    if (score.colour_fit) {
      right_half.Add(score.colour_fit->psnr_before);
      colour_fitted.Add(score.colour_fit->psnr_after);
    }
    squared_error.Add(score.mean_squared_error);
  }
  Json metrics = {{"psnr", psnr.ToJson()},
                  {"ssim", ssim.ToJson()},
                  {"lpips", distance.ToJson()},
                  {"n_images", scores.size()},
                  {"variants",
                   {{"psnr_pooled", scores.empty() ? Json() : Finite(PsnrOf(squared_error.ToJson().get<double>()))},
                    {"psnr_quantised", quantised.ToJson()},
                    {"psnr_foreground", foreground.ToJson()},
                    {"psnr_whole", whole.ToJson()},
                    {"psnr_right_half", right_half.ToJson()},
                    {"psnr_colour_fitted", colour_fitted.ToJson()}}}};
  if (psnr.empty()) metrics["psnr_reason"] = scores.empty() ? nothing : "every image is identical to its photo";
  if (ssim.empty()) metrics["ssim_reason"] = scores.empty() ? nothing : "no window lies in any image";
  if (distance.empty()) {
    metrics["lpips_reason"] = lpips.network == nullptr ? lpips.decision.reason
                              : scores.empty()         ? nothing
                                                       : "every image is smaller than the network can take";
  }
  const int n_identical = int(scores.size()) - psnr.n();
  if (n_identical > 0) metrics["n_identical"] = n_identical;
  return metrics;
}

Json MetricsProtocol(const LpipsNetwork* lpips) {
  Json protocol = {{"range", {0, 1}},
                   {"ssim",
                    {{"window", kSsimWindow},
                     {"weights", "Gaussian"},
                     {"sigma", kSsimSigma},
                     {"k1", kSsimK1},
                     {"k2", kSsimK2},
                     {"border", "valid"},
                     {"channels", "RGB, mean of the three"},
                     {"covariance", "population"}}},
                   {"mean", "every figure per image, then the mean of the images"},
                   {"variants",
                    {{"psnr_pooled", "of the mean squared error over all images"},
                     {"psnr_quantised", "both images rounded to 8 bits first"},
                     {"psnr_foreground", "over the pixels with an alpha of a half or more"},
                     {"psnr_whole", "over the whole images, where masks leave something out of the other figures"},
                     {"psnr_right_half", "over the right half of every image"},
                     {"psnr_colour_fitted",
                      "over the right half, with the rendered colours fitted to the photo's on the left half by an "
                      "affine map of RGB"}}},
                   {"error_map", {{"measure", "root mean square over RGB"}, {"range", {0, kErrorMapRange}}}}};
  if (lpips != nullptr) {
    protocol["lpips"] = {{"network", lpips->network()}, {"version", lpips->version()}, {"hash", lpips->hash()}};
  }
  return protocol;
}

}  // namespace nrff
