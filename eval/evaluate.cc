#include "eval/evaluate.h"

#include <atomic>
#include <cmath>
#include <future>
#include <map>
#include <mutex>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "eval/error_map.h"
#include "eval/metrics.h"
#include "eval/png.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"
#include "pipeline/log.h"
#include "pipeline/progress.h"
#include "pipeline/scene.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr int kRendersSchemaVersion = 1;
constexpr int kMetricsSchemaVersion = 1;
constexpr char kNoViewReason[] = "no held-out view was registered, so there is nothing to compare with";

struct Score {
  double psnr = 0;             // dB; infinite when identical
  std::optional<double> ssim;  // none when the image is smaller than the window
  std::optional<double> lpips;
};

// What alpha is composited on. Where a scene names nothing, black: what a pixel without a colour shows.
Background BehindAlpha(Background background) {
  return background == Background::kNone ? Background::kBlack : background;
}

// The view's pixels as RGB; RGBA (straight alpha) over the background, rounded.
Rgb8Image Composited(const View& view, const uint8_t* pixels, Background background) {
  Rgb8Image image{view.width, view.height, {}};
  const size_t n_pixels = size_t(view.width) * view.height;
  if (view.channels == 3) {
    image.rgb.assign(pixels, pixels + 3 * n_pixels);
    return image;
  }
  image.rgb.resize(3 * n_pixels);
  const int behind = BehindAlpha(background) == Background::kWhite ? 255 : 0;
  for (size_t i = 0; i < n_pixels; ++i) {
    const int alpha = pixels[4 * i + 3];
    for (size_t c = 0; c < 3; ++c) {
      image.rgb[3 * i + c] = uint8_t((pixels[4 * i + c] * alpha + behind * (255 - alpha) + 127) / 255);
    }
  }
  return image;
}

RgbImage ToUnitRange(const Rgb8Image& image) {
  RgbImage unit{image.width, image.height, std::vector<double>(image.rgb.size())};
  for (size_t i = 0; i < image.rgb.size(); ++i) unit.rgb[i] = image.rgb[i] / 255.0;
  return unit;
}

// Id → path of the rendered image, relative to the render artifact.
std::map<std::string, std::string> RenderedPaths(const fs::path& renders_dir) {
  const fs::path file = renders_dir / "renders.json";
  const std::string where = EscapePath(file);
  const Json renders = ReadJson(file);
  CheckSchemaVersion(renders, kRendersSchemaVersion, where);
  std::map<std::string, std::string> paths;
  for (const Json& view : Get<Json>(renders, "views", where)) {
    paths[Get<std::string>(view, "id", where)] = Get<std::string>(view, "rgb", where);
  }
  return paths;
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

// LPIPS for many threads, one at a time: OpenCV uses all cores for each.
class SharedLpips {
 public:
  explicit SharedLpips(LpipsNetwork* network) : network_(network) {}

  std::optional<double> Distance(const RgbImage& truth, const RgbImage& rendered) {
    if (network_ == nullptr) return std::nullopt;
    const std::lock_guard lock(mutex_);
    return network_->Distance(truth, rendered);
  }

 private:
  LpipsNetwork* network_;
  std::mutex mutex_;
};

// Truth, render and error of one view: writes the two pictures, returns the figures.
Score ScoreView(const View& view, const Rgb8Image& truth, const fs::path& rendered_path, const fs::path& out,
                SharedLpips& lpips) {
  const Rgb8Image rendered = ReadRgbPng(rendered_path);
  if (rendered.width != view.width || rendered.height != view.height) {
    throw InputError("Image " + EscapePath(rendered_path) + " is " + std::to_string(rendered.width) + "×" +
                     std::to_string(rendered.height) + " px but its photo in the scene " + std::to_string(view.width) +
                     "×" + std::to_string(view.height) + " px; render the views again from this scene.");
  }
  const RgbImage truth_unit = ToUnitRange(truth), rendered_unit = ToUnitRange(rendered);
  WriteRgbPng(out / "truth" / (view.id + ".png"), truth);
  WriteRgbPng(out / "error" / (view.id + ".png"), {view.width, view.height, ErrorMap(truth_unit, rendered_unit)});
  return {Psnr(truth_unit, rendered_unit), Ssim(truth_unit, rendered_unit), lpips.Distance(truth_unit, rendered_unit)};
}

Json ImageEntry(const View& view, const Score& score, const std::string& rendered_path, bool with_lpips) {
  Json entry = {{"id", view.id},
                {"name", view.name},
                {"width", view.width},
                {"height", view.height},
                {"psnr", score.psnr},
                {"ssim", nullptr},
                {"lpips", nullptr},
                {"rendered", rendered_path},
                {"truth", "truth/" + view.id + ".png"},
                {"error", "error/" + view.id + ".png"}};
  if (std::isinf(score.psnr)) {
    entry["psnr"] = nullptr;
    entry["identical"] = true;
  }
  if (score.ssim) {
    entry["ssim"] = *score.ssim;
  } else {
    entry["ssim_reason"] = "the image is smaller than the window of " + std::to_string(kSsimWindow) + " px";
  }
  if (score.lpips) {
    entry["lpips"] = *score.lpips;
  } else if (with_lpips) {
    entry["lpips_reason"] = "the image is smaller than " + std::to_string(kLpipsSmallest) + " px";
  }
  return entry;
}

Json Means(const std::vector<Score>& scores, const LpipsChoice& lpips) {
  double psnr_sum = 0, ssim_sum = 0, lpips_sum = 0;
  int n_psnr = 0, n_ssim = 0, n_lpips = 0;
  for (const Score& score : scores) {
    if (std::isfinite(score.psnr)) psnr_sum += score.psnr, ++n_psnr;
    if (score.ssim) ssim_sum += *score.ssim, ++n_ssim;
    if (score.lpips) lpips_sum += *score.lpips, ++n_lpips;
  }
  Json metrics = {{"psnr", nullptr}, {"ssim", nullptr}, {"lpips", nullptr}, {"n_images", scores.size()}};
  if (n_psnr > 0) {
    metrics["psnr"] = psnr_sum / n_psnr;
  } else {
    metrics["psnr_reason"] = scores.empty() ? kNoViewReason : "every image is identical to its photo";
  }
  if (n_ssim > 0) {
    metrics["ssim"] = ssim_sum / n_ssim;
  } else {
    metrics["ssim_reason"] = scores.empty() ? kNoViewReason : "every image is smaller than the window";
  }
  if (n_lpips > 0) {
    metrics["lpips"] = lpips_sum / n_lpips;
  } else {
    metrics["lpips_reason"] = lpips.network == nullptr ? lpips.decision.reason
                              : scores.empty()         ? kNoViewReason
                                                       : "every image is smaller than the network can take";
  }
  const int n_identical = int(scores.size()) - n_psnr;
  if (n_identical > 0) metrics["n_identical"] = n_identical;
  return metrics;
}

Json Protocol(const Scene& scene, const std::vector<int>& held_out, const std::string& split_rule,
              const LpipsNetwork* lpips) {
  Json names = Json::array();
  bool has_alpha = false;
  for (int index : held_out) {
    names.push_back(scene.views[index].name);
    has_alpha = has_alpha || scene.views[index].channels == 4;
  }
  Json protocol = {{"range", {0, 1}},
                   {"quantised", true},
                   {"background", BackgroundName(has_alpha ? BehindAlpha(scene.background) : Background::kNone)},
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
                   {"split", split_rule},
                   {"resize", "area average"},
                   {"images", names},
                   {"error_map", {{"measure", "root mean square over RGB"}, {"range", {0, kErrorMapRange}}}}};
  if (lpips != nullptr) {
    protocol["lpips"] = {{"network", lpips->network()}, {"version", lpips->version()}, {"hash", lpips->hash()}};
  }
  return protocol;
}

}  // namespace

LpipsChoice ChooseLpips(const std::string& network) {
  LpipsChoice choice{nullptr, needs::Lpips(network)};
  if (!choice.decision.needed) return choice;
  choice.network = std::make_unique<LpipsNetwork>(network);
  choice.network->RequirePublished();
  return choice;
}

void Evaluate(const fs::path& scene_dir, const fs::path& renders_dir, const fs::path& out_dir, const Params& params,
              const LpipsChoice& lpips, int n_threads) {
  const Manifest scene_manifest = RequireArtifact(scene_dir, "pose");
  const Manifest renders_manifest = RequireArtifact(renders_dir, "render");
  const Scene scene = LoadScene(scene_dir);
  const ImagePack pack(scene_dir);
  const std::vector<int> held_out = scene.ViewsOf(Split::kTest);
  const std::map<std::string, std::string> rendered_paths = RenderedPaths(renders_dir);

  ArtifactWriter artifact("eval", out_dir, params,
                          {ArtifactInput(scene_dir, scene_manifest), ArtifactInput(renders_dir, renders_manifest)});
  fs::create_directories(artifact.dir() / "truth");
  fs::create_directories(artifact.dir() / "error");

  std::vector<Score> scores(held_out.size());
  std::vector<Json> entries(held_out.size());
  Progress progress("scoring", double(held_out.size()), "views");
  SharedLpips shared_lpips(lpips.network.get());
  std::mutex progress_mutex;
  int n_done = 0;
  ForEachIndex(held_out.size(), n_threads, [&](size_t i) {
    const View& view = scene.views[held_out[i]];
    const auto rendered = rendered_paths.find(view.id);
    if (rendered == rendered_paths.end()) {
      throw InputError("Held-out view " + view.id + " (" + view.name + ") is not in " + EscapePath(renders_dir) +
                       "/renders.json; render the held-out views again.");
    }
    const fs::path rendered_path = renders_dir / UnescapePath(rendered->second);
    scores[i] = ScoreView(view, Composited(view, pack.Pixels(view), scene.background), rendered_path, artifact.dir(),
                          shared_lpips);
    entries[i] =
        ImageEntry(view, scores[i], EscapePath(fs::proximate(rendered_path, out_dir)), lpips.network != nullptr);
    const std::lock_guard lock(progress_mutex);
    progress.Update(++n_done);
  });
  progress.Done();

  const Json metrics = Means(scores, lpips);
  const Json protocol = Protocol(
      scene, held_out, scene_manifest.facts.value("split_rule", std::string("as recorded in the scene's views")),
      lpips.network.get());
  WriteJson(
      artifact.dir() / "metrics.json",
      {{"schema_version", kMetricsSchemaVersion}, {"protocol", protocol}, {"metrics", metrics}, {"images", entries}});
  artifact.facts() = metrics;
  artifact.facts()["protocol"] = protocol;
  artifact.AddDecision(lpips.decision);
  for (const char* output : {"metrics.json", "truth", "error"}) artifact.AddOutput(output);
  artifact.Commit();
  if (scores.empty()) LogWarning(std::string("nothing was scored: ") + kNoViewReason);
}

}  // namespace nrff
