#include "sfm/recognise.h"

#include <algorithm>
#include <array>
#include <cctype>
#include <optional>
#include <set>
#include <string>
#include <string_view>
#include <system_error>
#include <utility>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/photo_name.h"
#include "sfm/colmap_source.h"
#include "sfm/masks.h"
#include "sfm/nsvf.h"
#include "sfm/transforms_json.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

// Why a file that somebody may take for part of the capture is passed over; nothing for other files.
std::optional<std::string> WhyPassedOver(const fs::path& file) {
  constexpr std::array kRaw = std::to_array<std::string_view>(
      {".nef", ".nrw", ".cr2", ".cr3", ".crw", ".arw", ".dng", ".raf", ".orf", ".rw2", ".pef", ".srw", ".3fr", ".iiq"});
  std::string extension = file.extension();
  std::transform(extension.begin(), extension.end(), extension.begin(),
                 [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  if (std::find(kRaw.begin(), kRaw.end(), extension) == kRaw.end()) return {};
  return "is a camera raw file: export it as JPEG or TIFF";
}

// Files that lie beside a photo of the same name belong to it: a raw file is its original, a video its live photo.
// Other videos are part of the capture, other raw files are passed over.
void SortOthers(const std::vector<fs::path>& files, Source& source) {
  std::set<fs::path> photos;
  for (const SourceImage& image : source.images) photos.insert(fs::path(image.path).replace_extension());
  for (const fs::path& file : files) {
    const fs::path path = file.lexically_relative(source.root);
    const std::optional<std::string> why = WhyPassedOver(path);
    const bool is_video = HasVideoExtension(path) && !IsInMaskFolder(path);
    if (photos.contains(fs::path(path).replace_extension())) {
      if (is_video) {
        source.rejected.push_back(
            {EscapePath(path), "is taken for the live photo of the photo of its name: rename it to use its frames"});
      }
      continue;
    }
    if (why) source.rejected.push_back({EscapePath(path), *why});
    if (is_video) source.videos.push_back(path);
  }
}

Source ReadPhotoFolder(const fs::path& root) {
  Source source;
  source.kind = "photos";
  source.root = root;
  const std::vector<fs::path> files = ListFiles(root);
  std::vector<fs::path> photos;
  for (const fs::path& file : files) {
    if (HasPhotoExtension(file)) photos.push_back(file.lexically_relative(root));
  }
  // Where all photos lie in a folder of that name, it holds photos.
  const bool has_masks = !std::all_of(photos.begin(), photos.end(), IsInMaskFolder);
  for (const fs::path& photo : photos) {
    if (!has_masks || !IsInMaskFolder(photo)) source.images.push_back({photo, {}});
  }
  SortOthers(files, source);
  if (source.images.empty() && source.videos.empty()) {
    const RejectedFile* passed_over = source.rejected.empty() ? nullptr : &source.rejected.front();
    throw InputError(
        EscapePath(root) + ": holds no capture (files: " + std::to_string(files.size()) + ", photos: none" +
        (passed_over ? "; " + passed_over->name + " " + passed_over->reason : "") +
        "); expected photos (JPEG, PNG, TIFF, WebP, HEIC), videos, transforms.json, an NSVF layout or a COLMAP"
        " model with images");
  }
  source.evidence = std::to_string(source.images.size()) + " photos";
  if (!source.videos.empty()) source.evidence += ", " + std::to_string(source.videos.size()) + " videos";
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
  if (IsFile(root) && HasVideoExtension(root)) {
    Source source;
    source.kind = "photos";
    source.evidence = "a video";
    source.name = EscapePath(CaptureFolderName(root));
    source.root = root.parent_path();
    source.given = root;
    source.videos = {root.filename()};
    return source;
  }
  if (!fs::is_directory(root, error)) {
    throw InputError(EscapePath(root) +
                     ": is a file and no video; one photo or file cannot be reconstructed, give a folder of photos");
  }
  const fs::directory_iterator listing(root, error);
  if (error) throw InputError(EscapePath(root) + ": cannot be listed (" + error.message() + "); check its permissions");
  Source source = ReadSource(root);
  source.name = EscapePath(CaptureFolderName(root));
  source.given = root;
  SortAndRejectRepeated(source);
  AttachMasks(source);
  return source;
}

}  // namespace nrff
