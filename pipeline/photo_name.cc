#include "pipeline/photo_name.h"

#include <algorithm>
#include <array>
#include <string>
#include <string_view>

namespace nrff {
namespace {

constexpr std::array<std::string_view, 8> kPhotos = {".jpg",  ".jpeg", ".png",  ".tif",
                                                     ".tiff", ".webp", ".heic", ".heif"};
constexpr std::array<std::string_view, 15> kVideos = {".mp4", ".mov", ".m4v", ".avi",  ".mkv", ".webm", ".mts", ".m2ts",
                                                      ".ts",  ".3gp", ".mpg", ".mpeg", ".wmv", ".flv",  ".ogv"};

template <typename Extensions>
bool HasExtensionOf(const Extensions& extensions, const std::filesystem::path& path) {
  std::string extension = path.extension();
  std::transform(extension.begin(), extension.end(), extension.begin(),
                 [](char c) { return c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c; });
  return std::find(extensions.begin(), extensions.end(), extension) != extensions.end();
}

}  // namespace

bool HasPhotoExtension(const std::filesystem::path& path) { return HasExtensionOf(kPhotos, path); }

bool HasVideoExtension(const std::filesystem::path& path) { return HasExtensionOf(kVideos, path); }

}  // namespace nrff
