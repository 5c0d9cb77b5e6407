#include "sfm/masks.h"

#include <algorithm>
#include <cctype>
#include <map>
#include <set>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/photo_name.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr uint8_t kCounts = 128;

bool IsMaskFolder(const fs::path& name) {
  std::string lower = name.string();
  std::transform(lower.begin(), lower.end(), lower.begin(),
                 [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  return lower == "masks" || lower == "mask";
}

std::vector<fs::path> Parts(const fs::path& path) { return {path.begin(), path.end()}; }

fs::path Without(const std::vector<fs::path>& parts, size_t left_out) {
  fs::path path;
  for (size_t i = 0; i < parts.size(); ++i) {
    if (i != left_out) path /= parts[i];
  }
  return path;
}

// Which of the path's folders is one of masks; nothing for none.
std::optional<size_t> MaskFolder(const std::vector<fs::path>& parts) {
  for (size_t i = 0; i + 1 < parts.size(); ++i) {
    if (IsMaskFolder(parts[i])) return i;
  }
  return {};
}

}  // namespace

bool IsInMaskFolder(const fs::path& relative) { return MaskFolder(Parts(relative)).has_value(); }

void AttachMasks(Source& source) {
  std::set<fs::path> photos;
  for (const SourceImage& image : source.images) photos.insert(image.path);
  std::map<fs::path, fs::path> masks;  // by what a photo of theirs is called
  for (const fs::path& file : ListFiles(source.root)) {
    const fs::path path = file.lexically_relative(source.root);
    const std::vector<fs::path> parts = Parts(path);
    const std::optional<size_t> folder = MaskFolder(parts);
    if (!folder || !HasPhotoExtension(path) || photos.contains(path)) continue;
    const auto [first, is_new] = masks.emplace(Without(parts, *folder).replace_extension(), path);
    if (!is_new) {
      source.rejected.push_back({EscapePath(path), "is called as the mask " + EscapePath(first->second) + " is"});
    }
  }
  if (masks.empty()) return;
  std::map<fs::path, fs::path> used;  // masks, and whose they are
  for (SourceImage& image : source.images) {
    const std::vector<fs::path> parts = Parts(image.path);
    if (!image.mask.empty()) {  // given, and perhaps that of all photos of a rig
      used.emplace(image.mask, image.path);
      continue;
    }
    // At the photo's own place first, then with one of its folders left out, the innermost first.
    for (size_t left_out = parts.size(); image.mask.empty() && left_out-- > 0;) {
      const fs::path place = left_out + 1 == parts.size() ? image.path : Without(parts, left_out);
      for (const fs::path& name : {place, fs::path(place).replace_extension()}) {
        const auto mask = masks.find(name);
        if (image.mask.empty() && mask != masks.end()) image.mask = mask->second;
      }
    }
    if (image.mask.empty()) continue;
    const auto [first, is_new] = used.emplace(image.mask, image.path);
    if (!is_new) {
      throw InputError(EscapePath(source.root / image.mask) + ": may be the mask of " + EscapePath(first->second) +
                       " and of " + EscapePath(image.path) +
                       "; put masks into folders below it that are called as the photos' are");
    }
  }
  for (const auto& [name, path] : masks) {
    if (!used.contains(path)) source.rejected.push_back({EscapePath(path), "is a mask of no photo"});
  }
}

void ApplyMask(const fs::path& file, int orientation, Image& photo) {
  Image mask = ReadImageOriented(file);
  const bool turned = orientation >= 5;
  if (mask.width == photo.height && mask.height == photo.width && turned) mask = Oriented(std::move(mask), orientation);
  if (mask.width != photo.width || mask.height != photo.height) {
    throw InputError(EscapePath(file) + ": is " + std::to_string(mask.width) + "×" + std::to_string(mask.height) +
                     " px, but the photo it is the mask of is " + std::to_string(photo.width) + "×" +
                     std::to_string(photo.height) + " px");
  }
  const size_t n = size_t(photo.width) * size_t(photo.height);
  const auto counts = [&](size_t i) {
    const uint8_t* pixel = &mask.pixels[i * size_t(mask.channels)];
    return (pixel[0] + pixel[1] + pixel[2]) / 3 >= kCounts && (mask.channels == 3 || pixel[3] >= kCounts);
  };
  size_t n_counting = 0;
  for (size_t i = 0; i < n; ++i) n_counting += counts(i);
  if (n_counting == 0) throw InputError(EscapePath(file) + ": counts no pixel of its photo");
  if (n_counting == n) return;
  Image masked{photo.width, photo.height, 4, std::vector<uint8_t>(4 * n)};
  for (size_t i = 0; i < n; ++i) {
    const uint8_t* from = &photo.pixels[i * size_t(photo.channels)];
    std::copy_n(from, 3, &masked.pixels[4 * i]);
    masked.pixels[4 * i + 3] = !counts(i) ? 0 : photo.channels == 4 ? from[3] : 255;
  }
  photo = std::move(masked);
}

}  // namespace nrff
