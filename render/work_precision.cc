#include "render/work_precision.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <functional>
#include <memory>
#include <string>

#include "pipeline/progress.h"
#include "render/kernels/compositing.h"

namespace nrff {
namespace {

using Clock = std::chrono::steady_clock;

constexpr double kLimitStepShare = 1.0 / 8;
constexpr int kMostRepeats = 8;
constexpr double kEnoughSeconds = 1;  // of one setting

double SecondsSince(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

constexpr double kMostLevelsLeftOut = 8;

struct Family {
  std::string name, unit, meaning;
  bool against_limit = false;
  std::vector<double> values;
  double chosen = 0;  // one of `values`: what nrff-render uses
  std::function<void(RenderOptions&, double)> set;
  bool of_levels = false;  // values are numbers of levels that the field then lacks
};

// `values`, which fall, with what nrff-render uses among them.
std::vector<double> With(double chosen, std::vector<double> values) {
  if (std::find(values.begin(), values.end(), chosen) == values.end()) values.push_back(chosen);
  std::sort(values.rbegin(), values.rend());
  return values;
}

// Nothing that a picture could show is left out.
RenderOptions Exact(RenderOptions options) {
  options.weight_threshold = 0;
  options.stop_transmittance = 0;
  options.colour_tolerance = 0;
  options.precision = ShadingPrecision::kFloat;
  return options;
}

std::vector<Family> Families(const RenderOptions& trained, const RadianceField& field) {
  std::vector<double> levels;
  for (double n = 0; n <= kMostLevelsLeftOut && field.WithoutFinestLevels(int(n)) != nullptr; ++n) levels.push_back(n);
  std::reverse(levels.begin(), levels.end());
  const RenderOptions pictures = PictureOptions(trained, 8);
  const double picture_stop = std::max(pictures.stop_transmittance, 0.5 * pictures.colour_tolerance);
  return {
      {"step",
       "of the training's step",
       "distance between samples",
       true,
       {8, 4, 2, 1, 0.5, 0.25},
       1,
       [](RenderOptions& options, double value) { options.step *= value; }},
      {"weight threshold", "of a ray's light", "samples of less weight are not shaded", false,
       With(trained.weight_threshold, {1e-1, 3e-2, 1e-2, 1e-3, 1e-4, 1e-5, 0}), pictures.weight_threshold,
       [](RenderOptions& options, double value) { options.weight_threshold = value; }},
      {"early stop", "of a ray's light", "a ray ends where less is left", false,
       With(picture_stop, {0.3, 0.1, 3e-2, 1e-2, 1e-4, 1e-6, 0}), picture_stop,
       [](RenderOptions& options, double value) { options.stop_transmittance = value; }},
      {"colour tolerance",
       "of 1",
       "samples are shaded together as far as a colour may be off",
       false,
       {4. / 255, 2. / 255, 1. / 255, kEightBitTolerance, 0.25 / 255, 0.1 / 255, 0},
       kEightBitTolerance,
       [](RenderOptions& options, double value) { options.colour_tolerance = value; }},
      {"precision",
       "bits",
       "of the factors of the networks' products: bf16 or float",
       false,
       {16, 32},
       16,
       [](RenderOptions& options, double value) {
         options.precision = value < 32 ? ShadingPrecision::kBf16 : ShadingPrecision::kFloat;
       }},
      {"levels left out", "finest levels", "of the grids, without training again", false, levels, 0,
       [](RenderOptions&, double) {}, true},
      {"as nrff-render",
       "bits a colour",
       "weight threshold, early stop, colour tolerance and precision together",
       false,
       {8, 16},
       8,
       [trained](RenderOptions& options, double value) { options = PictureOptions(trained, int(value)); }},
  };
}

struct Difference {
  double squares = 0, most = 0;
  size_t n = 0;
  void Add(const std::vector<float>& a, const std::vector<float>& b) {
    for (size_t i = 0; i < a.size(); ++i) {
      const double difference = std::abs(double(a[i]) - b[i]);
      squares += difference * difference;
      most = std::max(most, difference);
    }
    n += a.size();
  }
  double MeanSquare() const { return squares / double(n); }
};

// Mean of the views' PSNR, dB.
class MeanPsnr {
 public:
  void Add(const RenderedImage& image, const TrueColours& truth) {
    Difference difference;
    std::vector<float> shown(image.rgb);
    for (float& value : shown) value = std::clamp(value, 0.F, 1.F);
    difference.Add(shown, truth.rgb);
    sum_ += -10 * std::log10(std::max(difference.MeanSquare(), 1e-20));
    ++n_;
  }
  double Value() const { return sum_ / n_; }

 private:
  double sum_ = 0;
  int n_ = 0;
};

class Sweep {
 public:
  Sweep(const RenderSource& source, const std::vector<View>& views, const std::vector<TrueColours>& truth)
      : source_(source), views_(views), truth_(truth) {}

  Json Run() {
    const std::vector<Family> families = Families(source_.options, source_.field);
    size_t n_points = 0;
    for (const Family& family : families) n_points += family.values.size();
    Progress progress("rendering at many settings", double(n_points + 2), "settings");
    RenderOptions limit = Exact(source_.options);
    limit.step *= kLimitStepShare;
    Render(source_.field, Exact(source_.options));  // fills caches and wakes the threads
    const Clock::time_point start = Clock::now();
    limit_ = Render(source_.field, limit);
    const double limit_seconds = SecondsSince(start) / double(views_.size());
    progress.Update(1);
    exact_ = Render(source_.field, Exact(source_.options));
    progress.Update(2);
    Json result = {{"n_views", views_.size()}, {"reference_seconds", limit_seconds}, {"families", Json::array()}};
    double n_done = 2;
    for (const Family& family : families) {
      Json points = Json::array();
      for (const double value : family.values) {
        points.push_back(Point(family, value));
        progress.Update(++n_done);
      }
      result["families"].push_back({{"family", family.name},
                                    {"unit", family.unit},
                                    {"meaning", family.meaning},
                                    {"reference", family.against_limit ? "limit" : "exact"},
                                    {"points", points}});
    }
    progress.Done();
    return result;
  }

 private:
  std::vector<RenderedImage> Render(const RadianceField& field, const RenderOptions& options) const {
    std::vector<RenderedImage> images;
    images.reserve(views_.size());
    for (const View& view : views_) {
      images.push_back(RenderImage(field, source_.occupancy, source_.map, view, options));
      if (source_.finish) source_.finish(view, images.back());
    }
    return images;
  }

  Json Point(const Family& family, double value) const {
    RenderOptions options = Exact(source_.options);
    family.set(options, value);
    const std::unique_ptr<RadianceField> coarser =
        family.of_levels ? source_.field.WithoutFinestLevels(int(value)) : nullptr;
    const RadianceField& field = coarser != nullptr ? *coarser : source_.field;
    // The least of several times is what neighbours on the machine disturb least.
    std::vector<RenderedImage> images;
    double seconds = HUGE_VAL, total = 0;
    for (int repeat = 0; repeat == 0 || (repeat < kMostRepeats && total < kEnoughSeconds); ++repeat) {
      const Clock::time_point start = Clock::now();
      images = Render(field, options);
      const double once = SecondsSince(start);
      total += once;
      seconds = std::min(seconds, once / double(views_.size()));
    }
    Difference difference;
    MeanPsnr psnr;
    double n_samples = 0, n_shaded = 0, n_rays = 0;
    for (size_t i = 0; i < images.size(); ++i) {
      difference.Add(images[i].rgb, (family.against_limit ? limit_ : exact_)[i].rgb);
      psnr.Add(images[i], truth_[i]);
      n_samples += double(images[i].n_samples);
      n_shaded += double(images[i].n_shaded);
      n_rays += double(images[i].width) * images[i].height;
    }
    return {{"value", value},
            {"seconds", seconds},
            {"rmse", std::sqrt(difference.MeanSquare())},
            {"most", difference.most},
            {"psnr", psnr.Value()},
            {"samples_per_ray", n_samples / n_rays},
            {"shaded_per_ray", n_shaded / n_rays},
            {"chosen", value == family.chosen}};
  }

  const RenderSource& source_;
  const std::vector<View>& views_;
  const std::vector<TrueColours>& truth_;
  std::vector<RenderedImage> limit_, exact_;
};

// σ(x) on [0, 1] and what is left of the light behind it.
struct Density {
  const char* name;
  double (*sigma)(double x);
  double (*transmittance)();
};

constexpr double kOptical = 4;                  // optical thickness of each
constexpr double kWidth = 0.05, kCentre = 0.4;  // of the Gaussian
constexpr double kStepAt = 1 / 3.0;             // where the step's density begins

double GaussianShare() {
  const auto phi = [](double x) { return 0.5 * (1 + std::erf((x - kCentre) / (kWidth * std::sqrt(2.0)))); };
  return phi(1) - phi(0);
}

const Density kDensities[] = {
    {"constant", [](double) { return kOptical; }, [] { return std::exp(-kOptical); }},
    {"linear", [](double x) { return 2 * kOptical * x; }, [] { return std::exp(-kOptical); }},
    {"Gaussian",
     [](double x) {
       const double u = (x - kCentre) / kWidth;
       return kOptical / (kWidth * std::sqrt(2 * M_PI)) * std::exp(-0.5 * u * u);
     },
     [] { return std::exp(-kOptical * GaussianShare()); }},
    {"step", [](double x) { return x < kStepAt ? 0 : kOptical / (1 - kStepAt); }, [] { return std::exp(-kOptical); }},
};

Json QuadraturePoint(const Density& density, int64_t n_samples) {
  std::vector<float> sigma(n_samples), delta(n_samples, 1 / float(n_samples)), weights(n_samples);
  for (int64_t i = 0; i < n_samples; ++i) sigma[i] = float(density.sigma((double(i) + 0.5) / double(n_samples)));
  const int64_t offsets[] = {0, n_samples};
  float transmittance = 0;
  int64_t n_reached = 0;
  const WeightsArgs<float> args{.n_rays = 1,
                                .ray_offsets = offsets,
                                .sigma = sigma.data(),
                                .delta = delta.data(),
                                .weights = weights.data(),
                                .transmittance = &transmittance,
                                .n_reached = &n_reached};
  const int n_repeats = int(std::max<int64_t>(16, 100000 / n_samples));
  const Clock::time_point start = Clock::now();
  for (int repeat = 0; repeat < n_repeats; ++repeat) WeightsForwardCpu(args);
  return {{"n_samples", n_samples},
          {"seconds", SecondsSince(start) / n_repeats},
          {"error", std::abs(double(transmittance) - density.transmittance())}};
}

}  // namespace

Json RenderingWorkPrecision(const RenderSource& source, const std::vector<View>& views,
                            const std::vector<TrueColours>& truth) {
  return Sweep(source, views, truth).Run();
}

Json QuadratureWorkPrecision() {
  Json densities = Json::array();
  for (const Density& density : kDensities) {
    Json points = Json::array();
    for (int64_t n_samples = 1; n_samples <= 65536; n_samples *= 2) {
      points.push_back(QuadraturePoint(density, n_samples));
    }
    densities.push_back({{"density", density.name}, {"points", points}});
  }
  return densities;
}

}  // namespace nrff
