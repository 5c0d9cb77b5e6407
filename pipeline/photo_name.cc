#include "pipeline/photo_name.h"

#include <algorithm>
#include <array>
#include <string>
#include <string_view>

namespace nrff {
namespace {

constexpr std::array<std::string_view, 8> kExtensions = {".jpg",  ".jpeg", ".png",  ".tif",
                                                         ".tiff", ".webp", ".heic", ".heif"};

}  // namespace

bool HasPhotoExtension(const std::filesystem::path& path) {
  std::string extension = path.extension();
  std::transform(extension.begin(), extension.end(), extension.begin(),
                 [](char c) { return c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c; });
  return std::find(kExtensions.begin(), kExtensions.end(), extension) != kExtensions.end();
}

}  // namespace nrff
