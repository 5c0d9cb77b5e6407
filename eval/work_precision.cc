#include "eval/work_precision.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <optional>
#include <vector>

#include "pipeline/progress.h"

namespace nrff {
namespace {

using Clock = std::chrono::steady_clock;

constexpr int kFactors[] = {8, 4, 2, 1};

// Mean of the values that there are, and of the seconds that finding them took.
class Timed {
 public:
  template <typename Measure>
  void Add(const Measure& measure) {
    const Clock::time_point start = Clock::now();
    const std::optional<double> value = measure();
    if (!value || !std::isfinite(*value)) return;
    seconds_ += std::chrono::duration<double>(Clock::now() - start).count();
    sum_ += *value;
    ++n_;
  }
  Json Value() const { return n_ == 0 ? Json() : Json(sum_ / n_); }
  Json Seconds() const { return n_ == 0 ? Json() : Json(seconds_ / n_); }

 private:
  double sum_ = 0, seconds_ = 0;
  int n_ = 0;
};

}  // namespace

RgbImage Shrunk(const RgbImage& image, int factor) {
  RgbImage small{image.width / factor, image.height / factor, {}};
  small.rgb.resize(size_t(3) * small.width * small.height);
  const double share = 1.0 / (double(factor) * factor);
  for (int y = 0; y < small.height * factor; ++y) {
    const double* row = image.rgb.data() + size_t(3) * y * image.width;
    double* target = small.rgb.data() + size_t(3) * (y / factor) * small.width;
    for (int i = 0; i < 3 * small.width * factor; ++i) {
      target[3 * (i / (3 * factor)) + i % 3] += share * row[i];
    }
  }
  return small;
}

Json ScoringWorkPrecision(const HeldOutPairs& pairs, LpipsNetwork* lpips) {
  const size_t n_pairs = std::min(pairs.size(), kMostPairs);
  Progress progress("scoring at several sizes", double(n_pairs * std::size(kFactors)), "images");
  Json points = Json::array();
  int n_done = 0;
  for (const int factor : kFactors) {
    Timed psnr, ssim, distance;
    int width = 0, height = 0, n_images = 0;
    for (size_t i = 0; i < n_pairs; ++i) {
      const size_t index = i * pairs.size() / n_pairs;
      const View& view = pairs.ViewOf(index);
      if (std::min(view.width, view.height) < factor) continue;
      const HeldOutPairs::Pair pair = pairs.Read(index);
      const RgbImage truth = Shrunk(FromEightBits(view.width, view.height, pair.truth), factor);
      const RgbImage rendered = Shrunk(pair.rendered.rgb, factor);
      width = std::max(width, truth.width), height = std::max(height, truth.height);
      ++n_images;
      psnr.Add([&] { return std::optional(Psnr(truth, rendered)); });
      ssim.Add([&] { return Ssim(truth, rendered); });
      if (lpips != nullptr) distance.Add([&] { return lpips->Distance(truth, rendered); });
      progress.Update(++n_done);
    }
    if (width == 0) continue;
    points.push_back({{"factor", factor},
                      {"width", width},
                      {"height", height},
                      {"n_images", n_images},
                      {"psnr", psnr.Value()},
                      {"ssim", ssim.Value()},
                      {"lpips", distance.Value()},
                      {"seconds", {{"psnr", psnr.Seconds()}, {"ssim", ssim.Seconds()}, {"lpips", distance.Seconds()}}},
                      {"chosen", factor == 1}});
  }
  progress.Done();
  return points;
}

}  // namespace nrff
