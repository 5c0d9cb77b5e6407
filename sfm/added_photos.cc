#include "sfm/added_photos.h"

#include <algorithm>
#include <map>

#include "pipeline/files.h"

namespace nrff {

AddedPhotos FindAdded(const Capture& earlier, bool posed, bool has_videos, const std::vector<PhotoBytes>& now) {
  AddedPhotos found;
  const bool had_frames = std::any_of(earlier.images.begin(), earlier.images.end(),
                                      [](const CaptureImage& image) { return image.extracted; });
  if (posed || earlier.posed) {
    found.why_none = "poses come with the capture";
  } else if (has_videos || had_frames) {
    found.why_none = "frames of videos are chosen among all of them";
  }
  if (!found.why_none.empty()) return found;
  std::map<std::string, size_t> by_path;
  for (size_t i = 0; i < now.size(); ++i) by_path.emplace(now[i].path.native(), i);
  for (const CaptureImage& image : earlier.images) {
    const std::string name = EscapePath(image.path);
    const auto photo = by_path.find(image.path.native());
    if (photo == by_path.end()) {
      found.why_none = name + " is no longer among the photos that can be used";
      return found;
    }
    const PhotoBytes& bytes = now[photo->second];
    if (bytes.hash != image.hash || bytes.mask != image.mask || bytes.mask_hash != image.mask_hash) {
      found.why_none = (bytes.hash != image.hash ? "" : "the mask of ") + name + " was changed";
      return found;
    }
    found.earlier.push_back(photo->second);
    by_path.erase(photo);
  }
  for (const auto& [path, i] : by_path) found.added.push_back(i);
  std::sort(found.added.begin(), found.added.end());
  return found;
}

}  // namespace nrff
