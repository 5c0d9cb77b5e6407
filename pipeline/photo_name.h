// Which files are taken for photos and videos before they are opened.
#pragma once

#include <filesystem>

namespace nrff {

// Whether a file's name ends like that of a photo (.jpg .jpeg .png .tif .tiff .webp .heic .heif, in any case).
bool HasPhotoExtension(const std::filesystem::path& path);

// Whether a file's name ends like that of a video (.mp4 .mov .m4v .avi .mkv .webm .mts .m2ts .ts .3gp .mpg
// .mpeg .wmv .flv .ogv, in any case).
bool HasVideoExtension(const std::filesystem::path& path);

}  // namespace nrff
