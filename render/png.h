// PNG files, written whole or not at all.
#pragma once

#include <cstdint>
#include <filesystem>
#include <vector>

namespace nrff {

// data: height × width × channels, row-major; channels 1 (grey), 3 (RGB) or 4 (RGBA). Throws InputError on sizes that
// do not fit the data, ResourceError when the file cannot be written.
void WritePng(const std::filesystem::path& path, int width, int height, int channels, const std::vector<uint8_t>& data);
void WritePng(const std::filesystem::path& path, int width, int height, int channels,
              const std::vector<uint16_t>& data);

}  // namespace nrff
