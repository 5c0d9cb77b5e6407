// What was added to a capture since it was ingested, by the bytes of its photos.
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "sfm/capture.h"

namespace nrff {

// A photo as a capture's extension is told by.
struct PhotoBytes {
  std::filesystem::path path;  // relative to the root
  std::string hash;
  std::filesystem::path mask{};  // as path; empty: none
  std::string mask_hash{};
};

struct AddedPhotos {
  std::vector<size_t> earlier;  // places in `now` of the earlier capture's photos, in its order
  std::vector<size_t> added;    // of the others, in the order of `now`
  // One clause: why `now` is no extension of the earlier capture, as when a photo changed. Empty where it is one.
  std::string why_none;
};

// `now`: the photos that the capture has, in any order. Captures with poses or frames of videos are not extended: their
// poses, or the choice of frames, belong to all photos together.
AddedPhotos FindAdded(const Capture& earlier, bool posed, bool has_videos, const std::vector<PhotoBytes>& now);

}  // namespace nrff
