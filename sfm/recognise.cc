#include "sfm/recognise.h"

#include <algorithm>
#include <string>
#include <system_error>
#include <utility>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "sfm/colmap_source.h"
#include "sfm/nsvf.h"
#include "sfm/transforms_json.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

Source ReadPhotoFolder(const fs::path& root) {
  Source source;
  source.kind = "photos";
  source.root = root;
  const std::vector<fs::path> files = ListFiles(root);
  for (const fs::path& file : files) {
    if (HasPhotoExtension(file)) source.images.push_back({file.lexically_relative(root), {}});
  }
  if (source.images.empty()) {
    throw InputError(EscapePath(root) + ": holds no capture (" + std::to_string(files.size()) +
                     " files, none of them a photo); expected photos (JPEG, PNG, TIFF, WebP, HEIC), transforms.json,"
                     " an NSVF layout or a COLMAP model with images");
  }
  source.evidence = std::to_string(source.images.size()) + " photos";
  return source;
}

Source ReadSource(const fs::path& root) {
  for (auto read : {ReadTransformsSource, ReadNsvfSource, ReadColmapSource}) {
    if (auto source = read(root)) return std::move(*source);
  }
  return ReadPhotoFolder(root);
}

// The first pose of a photo is the one that counts: a view of the training set cannot be held out as well.
void SortAndRejectRepeated(Source& source) {
  std::stable_sort(source.images.begin(), source.images.end(),
                   [](const SourceImage& a, const SourceImage& b) { return a.path.native() < b.path.native(); });
  std::vector<SourceImage> unique;
  for (SourceImage& image : source.images) {
    if (!unique.empty() && unique.back().path == image.path) {
      source.rejected.push_back({EscapePath(image.path), "is named twice; the first pose is used"});
    } else {
      unique.push_back(std::move(image));
    }
  }
  source.images = std::move(unique);
}

}  // namespace

Source RecogniseCapture(const fs::path& root) {
  std::error_code error;
  if (!fs::exists(root, error))
    throw InputError(EscapePath(root) + ": does not exist; give the folder that holds the photos");
  if (!fs::is_directory(root, error)) {
    throw InputError(EscapePath(root) +
                     ": is a file; one photo or file cannot be reconstructed, give a folder of photos");
  }
  const fs::directory_iterator listing(root, error);
  if (error) throw InputError(EscapePath(root) + ": cannot be listed (" + error.message() + "); check its permissions");
  Source source = ReadSource(root);
  SortAndRejectRepeated(source);
  return source;
}

}  // namespace nrff
