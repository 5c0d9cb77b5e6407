#include "eval/held_out_pairs.h"

#include <algorithm>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"
#include "pipeline/log.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr int kRendersSchemaVersion = 1;

// What alpha is composited on. Where a scene names nothing, black: what a pixel without a colour shows.
Background BehindAlpha(Background background) {
  return background == Background::kNone ? Background::kBlack : background;
}

StoredImage PhotoOf(const View& view, const uint8_t* pixels) {
  const size_t n_pixels = size_t(view.width) * view.height;
  StoredImage photo{{view.width, view.height, std::vector<double>(3 * n_pixels)}, {}, 8};
  if (view.channels == 4) photo.alpha.resize(n_pixels);
  for (size_t i = 0; i < n_pixels; ++i, pixels += view.channels) {
    for (size_t c = 0; c < 3; ++c) photo.rgb.rgb[3 * i + c] = pixels[c] / 255.0;
    if (view.channels == 4) photo.alpha[i] = pixels[3] / 255.0;
  }
  return photo;
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

// The folder, once it is known to hold what the pose stage makes: its pack is opened before all else is read.
const fs::path& RequirePose(const fs::path& scene_dir) {
  RequireArtifact(scene_dir, "pose");
  return scene_dir;
}

}  // namespace

RgbImage FromEightBits(int width, int height, const std::vector<uint8_t>& rgb) {
  RgbImage image{width, height, std::vector<double>(rgb.size())};
  for (size_t i = 0; i < rgb.size(); ++i) image.rgb[i] = rgb[i] / 255.0;
  return image;
}

HeldOutPairs::HeldOutPairs(const fs::path& scene_dir, const fs::path& renders_dir)
    : renders_dir_(renders_dir), pack_(RequirePose(scene_dir)) {
  const Manifest scene_manifest = RequireArtifact(scene_dir, "pose");
  const Manifest renders_manifest = RequireArtifact(renders_dir, "render");
  inputs_ = {ArtifactInput(scene_dir, scene_manifest), ArtifactInput(renders_dir, renders_manifest)};
  split_rule_ = scene_manifest.facts.value("split_rule", std::string("as recorded in the scene's views"));
  scene_ = LoadScene(scene_dir);
  for (const int index : scene_.ViewsOf(Split::kTest)) {
    const View& view = scene_.views[index];
    const std::vector<double> alpha = PhotoOf(view, pack_.Pixels(view)).alpha;
    if (view.masked && std::count(alpha.begin(), alpha.end(), 1) == 0) {
      LogWarning("The mask of held-out view " + view.id + " (" + view.name + ") leaves no pixel at " +
                 SizeText(view.width, view.height) + "; it is not scored.");
    } else {
      held_out_.push_back(index);
    }
  }
  exposures_ = renders_manifest.facts.value("exposures", std::string("the field's own"));
  rendered_paths_ = RenderedPaths(renders_dir);
}

Background HeldOutPairs::background() const {
  const bool has_alpha = std::any_of(held_out_.begin(), held_out_.end(), [&](int index) {
    return scene_.views[index].channels == 4 && !scene_.views[index].masked;
  });
  return has_alpha ? BehindAlpha(scene_.background) : Background::kNone;
}

bool HeldOutPairs::masked() const {
  return std::any_of(held_out_.begin(), held_out_.end(), [&](int index) { return scene_.views[index].masked; });
}

HeldOutPairs::Pair HeldOutPairs::Read(size_t i) const {
  const View& view = ViewOf(i);
  const auto path = rendered_paths_.find(view.id);
  if (path == rendered_paths_.end()) {
    throw InputError("Held-out view " + view.id + " (" + view.name + ") is not in " + EscapePath(renders_dir_) +
                     "/renders.json; render the held-out views again.");
  }
  Pair pair;
  pair.rendered_path = renders_dir_ / UnescapePath(path->second);
  pair.rendered = ReadImage(pair.rendered_path);
  const RgbImage& rendered = pair.rendered.rgb;
  if (rendered.width != view.width || rendered.height != view.height) {
    throw InputError("Image " + EscapePath(pair.rendered_path) + " is " + SizeText(rendered.width, rendered.height) +
                     " but its photo in the scene " + SizeText(view.width, view.height) +
                     "; render the views again from this scene.");
  }
  pair.photo = PhotoOf(view, pack_.Pixels(view));
  if (!view.masked) {
    pair.truth = ToEightBits(Composited(pair.photo, BehindAlpha(scene_.background)));
    return pair;
  }
  pair.truth = ToEightBits(pair.photo.rgb);
  pair.counts.emplace();
  for (const double alpha : pair.photo.alpha) pair.counts->push_back(alpha == 1 ? 1 : 0);
  return pair;
}

}  // namespace nrff
