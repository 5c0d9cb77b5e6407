// Writing images.u8: photos are read, resampled and put at their place.
#pragma once

#include <filesystem>
#include <vector>

#include "sfm/capture.h"
#include "sfm/distortion.h"
#include "sfm/undistort.h"

namespace nrff {

struct PackEntry {
  const CaptureImage* photo = nullptr;
  const Lens* lens = nullptr;  // of the photo
  const PinholeTarget* target = nullptr;
  uint64_t offset = 0;  // bytes
};

// Creates `file` with `size_bytes` and fills in every entry. The space is claimed first, so that a full disk is found
// before the work is done. Throws ResourceError naming the file, and what ReadCapturedPhoto throws.
void WriteImagePack(const std::filesystem::path& file, uint64_t size_bytes, const Capture& capture,
                    const std::vector<PackEntry>& entries, int n_threads);

}  // namespace nrff
