// Which files are taken for photos before they are opened.
#pragma once

#include <filesystem>

namespace nrff {

// Whether a file's name ends like that of a photo (.jpg .jpeg .png .tif .tiff .webp .heic .heif, in any case).
bool HasPhotoExtension(const std::filesystem::path& path);

}  // namespace nrff
