#include "eval/evaluate.h"

#include <algorithm>
#include <iomanip>
#include <map>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "eval/error_map.h"
#include "eval/held_out_pairs.h"
#include "eval/image_file.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"
#include "pipeline/log.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr int kMetricsSchemaVersion = 1;
constexpr char kNoViewReason[] = "no held-out view was registered, so there is nothing to compare with";

std::optional<Mask> ForegroundOf(const StoredImage& photo) {
  Mask foreground;
  for (const double alpha : photo.alpha) foreground.push_back(alpha >= 0.5 ? 1 : 0);
  if (std::count(foreground.begin(), foreground.end(), 1) == 0) return std::nullopt;
  return foreground;
}

// What the images of a scoring have in common, as the protocol states it.
struct Common {
  std::string background, split, resize, exposures = {};
  bool masked = false;
};

// The images of one scoring, filled in by several threads, each its own places.
class Scoring {
 public:
  Scoring(size_t n, fs::path out) : entries_(n), bits_(n, {8, 8}), out_(std::move(out)) {
    fs::create_directories(out_ / "error");
  }

  Score Add(size_t i, const std::string& id, const ScoredPair& pair, const StoredImage& truth,
            const StoredImage& rendered, SharedLpips& lpips, bool with_lpips) {
    const Score score = ScoreImages(pair, lpips);
    const int width = pair.truth.width, height = pair.truth.height;
    WriteRgbPng(out_ / "error" / (id + ".png"), width, height, ErrorMap(pair.truth, pair.rendered));
    bits_[i] = {truth.bits, rendered.bits};
    Json& entry = entries_[i] = ScoreToJson(score, with_lpips);
    entry["id"] = id;
    entry["width"] = width;
    entry["height"] = height;
    entry["error"] = EscapePath("error/" + id + ".png");
    return score;
  }
  Json& entry(size_t i) { return entries_[i]; }

  // Writes metrics.json and commits the artifact.
  void Finish(const std::vector<Score>& scores, const LpipsChoice& lpips, const Common& common,
              ArtifactWriter& artifact) const {
    Json names = Json::array();
    for (const Json& entry : entries_) names.push_back(entry.at("name"));
    const auto most = [&](int Bits::*which) {
      int bits = 8;
      for (const Bits& b : bits_) bits = std::max(bits, b.*which);
      return bits;
    };
    const int truth = most(&Bits::truth), rendered = most(&Bits::rendered);
    Json protocol = MetricsProtocol(lpips.network.get());
    protocol["bits"] = {{"truth", truth}, {"rendered", rendered}};
    protocol["quantised"] = truth == 8 && rendered == 8;
    protocol["background"] = common.background;
    protocol["split"] = common.split;
    protocol["resize"] = common.resize;
    protocol["masked"] = common.masked;
    if (!common.exposures.empty()) protocol["exposures"] = common.exposures;
    protocol["images"] = names;
    const Json metrics = MeanScores(scores, lpips, kNoViewReason);
    WriteJson(artifact.dir() / "metrics.json", {{"schema_version", kMetricsSchemaVersion},
                                                {"protocol", protocol},
                                                {"metrics", metrics},
                                                {"images", entries_}});
    artifact.facts() = metrics;
    artifact.facts()["protocol"] = protocol;
    artifact.AddDecision(lpips.decision);
    for (const char* output : {"metrics.json", "truth", "error", "masks"}) {
      if (fs::exists(artifact.dir() / output)) artifact.AddOutput(output);
    }
    artifact.Commit();
  }

 private:
  struct Bits {
    int truth, rendered;
  };
  std::vector<Json> entries_;
  std::vector<Bits> bits_;
  fs::path out_;
};

// The images of a folder by their names without extension.
std::map<std::string, fs::path> ImagesByStem(const fs::path& folder) {
  if (!fs::is_directory(folder)) throw InputError(EscapePath(folder) + " is no folder; give one that holds images.");
  constexpr const char* kExtensions[] = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp"};
  std::map<std::string, fs::path> images;
  for (const fs::directory_entry& entry : fs::directory_iterator(folder)) {
    std::string extension = entry.path().extension();
    std::transform(extension.begin(), extension.end(), extension.begin(),
                   [](unsigned char c) { return char(std::tolower(c)); });
    if (std::find(std::begin(kExtensions), std::end(kExtensions), extension) == std::end(kExtensions)) continue;
    const auto [known, is_new] = images.emplace(entry.path().stem(), entry.path());
    if (!is_new) {
      throw InputError(EscapePath(known->second) + " and " + EscapePath(entry.path()) +
                       " differ in their extensions alone; remove one of them.");
    }
  }
  if (images.empty())
    throw InputError(EscapePath(folder) +
                     " holds no images (PNG, JPEG, TIFF, WebP); give the folder that they lie in.");
  return images;
}

const fs::path& CounterpartOf(const fs::path& image, const std::map<std::string, fs::path>& others,
                              const fs::path& folder) {
  const auto found = others.find(image.stem());
  if (found != others.end()) return found->second;
  throw InputError(EscapePath(image) + " has no image of that name in " + EscapePath(folder) +
                   "; names without extension have to be the same.");
}

void CheckSizes(const fs::path& first, const RgbImage& a, const fs::path& second, const RgbImage& b) {
  if (a.width == b.width && a.height == b.height) return;
  throw InputError("Image " + EscapePath(first) + " is " + SizeText(a.width, a.height) + " but " + EscapePath(second) +
                   " " + SizeText(b.width, b.height) + "; both must have the same size.");
}

}  // namespace

void Evaluate(const fs::path& scene_dir, const fs::path& renders_dir, const fs::path& out_dir, const Params& params,
              const LpipsChoice& lpips, int n_threads) {
  const HeldOutPairs pairs(scene_dir, renders_dir);
  ArtifactWriter artifact("eval", out_dir, params, pairs.inputs());
  fs::create_directories(artifact.dir() / "truth");
  if (pairs.masked()) fs::create_directories(artifact.dir() / "masks");
  Scoring scoring(pairs.size(), artifact.dir());
  SharedLpips shared_lpips(lpips.network.get());
  const std::vector<Score> scores = ScoreAll(pairs.size(), n_threads, [&](size_t i) {
    const View& view = pairs.ViewOf(i);
    const HeldOutPairs::Pair read = pairs.Read(i);
    const std::string truth_path = "truth/" + view.id + ".png", mask_path = "masks/" + view.id + ".png";
    WriteRgbPng(artifact.dir() / truth_path, view.width, view.height, read.truth);
    ScoredPair pair{FromEightBits(view.width, view.height, read.truth), read.rendered.rgb, {}, {}};
    if (read.counts) {
      std::vector<uint8_t> mask;
      for (const uint8_t counts : *read.counts) mask.insert(mask.end(), 3, counts != 0 ? 255 : 0);
      WriteRgbPng(artifact.dir() / mask_path, view.width, view.height, mask);
      Hide(*read.counts, Background::kBlack, pair);
    } else {
      pair.foreground = ForegroundOf(read.photo);
    }
    const Score score =
        scoring.Add(i, view.id, pair, read.photo, read.rendered, shared_lpips, lpips.network != nullptr);
    scoring.entry(i)["name"] = view.name;
    scoring.entry(i)["truth"] = truth_path;
    if (read.counts) scoring.entry(i)["mask"] = mask_path;
    scoring.entry(i)["rendered"] = EscapePath(fs::proximate(read.rendered_path, out_dir));
    return score;
  });
  scoring.Finish(
      scores, lpips,
      {BackgroundName(pairs.background()), pairs.split_rule(), "area average", pairs.exposures(), pairs.masked()},
      artifact);
  if (scores.empty()) LogWarning(std::string("nothing was scored: ") + kNoViewReason);
}

void Compare(const Folders& folders, const fs::path& out_dir, const Params& params, const LpipsChoice& lpips,
             int n_threads) {
  const std::map<std::string, fs::path> truths = ImagesByStem(folders.truth);
  const std::map<std::string, fs::path> masks =
      folders.masks.empty() ? std::map<std::string, fs::path>() : ImagesByStem(folders.masks);
  std::vector<fs::path> rendered_paths;
  for (const auto& [stem, path] : ImagesByStem(folders.rendered)) rendered_paths.push_back(path);
  if (rendered_paths.size() < truths.size()) {
    LogWarning(EscapePath(folders.rendered) + " has " + std::to_string(rendered_paths.size()) + " of the " +
               std::to_string(truths.size()) + " images of " + EscapePath(folders.truth) + ": the rest is not scored");
  }
  std::vector<HashedPath> inputs;
  for (const fs::path& folder : {folders.truth, folders.rendered, folders.masks}) {
    if (!folder.empty()) inputs.push_back({EscapePath(folder), HashTree(folder), 0});
  }
  ArtifactWriter artifact("eval", out_dir, params, inputs);
  Scoring scoring(rendered_paths.size(), artifact.dir());
  SharedLpips shared_lpips(lpips.network.get());
  std::vector<uint8_t> has_alpha(rendered_paths.size());
  const std::vector<Score> scores = ScoreAll(rendered_paths.size(), n_threads, [&](size_t i) {
    const fs::path& rendered_path = rendered_paths[i];
    const fs::path& truth_path = CounterpartOf(rendered_path, truths, folders.truth);
    const StoredImage truth = ReadImage(truth_path), rendered = ReadImage(rendered_path);
    CheckSizes(rendered_path, rendered.rgb, truth_path, truth.rgb);
    has_alpha[i] = !truth.alpha.empty() || !rendered.alpha.empty();
    ScoredPair pair{
        Composited(truth, folders.background), Composited(rendered, folders.background), {}, ForegroundOf(truth)};
    if (!folders.masks.empty()) {
      const fs::path& mask_path = CounterpartOf(rendered_path, masks, folders.masks);
      const StoredImage mask = ReadImage(mask_path);
      CheckSizes(mask_path, mask.rgb, truth_path, truth.rgb);
      Mask counts;
      for (size_t p = 0; p < mask.rgb.rgb.size(); p += 3) counts.push_back(mask.rgb.rgb[p] >= 0.5 ? 1 : 0);
      if (std::count(counts.begin(), counts.end(), 1) == 0) {
        throw InputError("Mask " + EscapePath(mask_path) + " is black all over; it leaves no pixel to compare.");
      }
      Hide(std::move(counts), folders.background, pair);
    }
    const std::string id = EscapePath(rendered_path.stem());
    const Score score = scoring.Add(i, id, pair, truth, rendered, shared_lpips, lpips.network != nullptr);
    scoring.entry(i)["name"] = EscapePath(rendered_path.filename());
    scoring.entry(i)["truth"] = EscapePath(fs::proximate(truth_path, out_dir));
    scoring.entry(i)["rendered"] = EscapePath(fs::proximate(rendered_path, out_dir));
    return score;
  });
  const bool any_alpha = std::count(has_alpha.begin(), has_alpha.end(), 1) > 0;
  scoring.Finish(scores, lpips,
                 {BackgroundName(any_alpha || !masks.empty() ? folders.background : Background::kNone),
                  "the images of a folder", "none", "", !masks.empty()},
                 artifact);
  const auto text = [&](const char* key, int digits) {
    const Json& value = artifact.facts().at(key);
    if (value.is_null()) return std::string("none");
    std::ostringstream fixed;
    fixed << std::fixed << std::setprecision(digits) << value.get<double>();
    return fixed.str();
  };
  LogInfo("mean of " + std::to_string(scores.size()) + " images: PSNR " + text("psnr", 2) + " dB, SSIM " +
          text("ssim", 4) + ", LPIPS " + text("lpips", 4) + " (" + EscapePath(out_dir / "metrics.json") + ")");
}

}  // namespace nrff
