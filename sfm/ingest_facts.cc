#include "sfm/ingest_facts.h"

#include <algorithm>
#include <string>
#include <utility>
#include <vector>

#include "pipeline/log.h"
#include "sfm/masks.h"

namespace nrff {
namespace {

double MedianBlur(const std::vector<CaptureImage>& images) {
  std::vector<double> blur;
  blur.reserve(images.size());
  for (const CaptureImage& image : images) blur.push_back(image.blur);
  std::nth_element(blur.begin(), blur.begin() + static_cast<std::ptrdiff_t>(blur.size() / 2), blur.end());
  return blur[blur.size() / 2];
}

}  // namespace

Json IngestFacts(const Capture& capture, int n_cameras) {
  int width = 0, height = 0, n_masks = 0, n_test = 0;
  bool has_alpha = false;
  for (const CaptureImage& image : capture.images) {
    n_masks += image.mask.empty() ? 0 : 1;
    n_test += image.split == Split::kTest ? 1 : 0;
    width = std::max(width, image.info.width);
    height = std::max(height, image.info.height);
    has_alpha |= image.info.channels == 4;
  }
  Json rejected = Json::array();
  for (const RejectedFile& file : capture.rejected) rejected.push_back({{"name", file.name}, {"reason", file.reason}});
  const auto n_images = static_cast<int>(capture.images.size());
  return {{"kind", capture.kind},
          {"name", capture.name},
          {"n_images", n_images},
          {"n_rejected", capture.rejected.size()},
          {"n_train", n_images - n_test},
          {"n_test", n_test},
          {"split_rule", capture.split_rule},
          {"posed", capture.posed},
          {"has_alpha", has_alpha},
          {"n_masks", n_masks},
          {"masks", has_alpha ? Json(MasksName(capture.masks)) : Json()},
          {"ordered", capture.ordered},
          {"n_cameras", n_cameras},
          {"width", width},
          {"height", height},
          {"rejected", std::move(rejected)},
          {"duplicates", capture.duplicates},
          {"blur_median", MedianBlur(capture.images)},
          {"background", BackgroundName(capture.background)}};
}

void LogIngestFacts(const Capture& capture, const Json& facts) {
  LogInfo(capture.name + ": " + facts["n_images"].dump() + " photos, " + facts["n_train"].dump() + " to train, " +
          facts["n_test"].dump() + " held out (" + capture.split_rule + ")");
  if (const int n_masks = facts["n_masks"]; n_masks > 0) {
    LogInfo(std::to_string(n_masks) + " photos have masks, which leave out " +
            (capture.masks == Masks::kIgnore ? "pixels that do not count" : "the background"));
  }
  for (const RejectedFile& file : capture.rejected) LogDetail("left out: " + file.name + " " + file.reason);
  if (!capture.rejected.empty()) {
    LogWarning(std::to_string(capture.rejected.size()) + " files are left out, the first: " +
               capture.rejected.front().name + " " + capture.rejected.front().reason);
  }
  for (const std::vector<std::string>& group : capture.duplicates) {
    LogDetail(std::to_string(group.size()) + " photos look alike, from " + group.front() + " to " + group.back());
  }
}

}  // namespace nrff
