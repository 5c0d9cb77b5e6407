// 8-bit RGB PNG files as evaluation reads and writes them.
#pragma once

#include <cstdint>
#include <filesystem>
#include <vector>

namespace nrff {

struct Rgb8Image {
  int width = 0, height = 0;  // px
  std::vector<uint8_t> rgb;   // [height, width, 3] row-major
};

// Throws InputError naming the file: absent, damaged, cut short, not three channels of 8 bits.
Rgb8Image ReadRgbPng(const std::filesystem::path& path);

// Throws ResourceError naming the file.
void WriteRgbPng(const std::filesystem::path& path, const Rgb8Image& image);

}  // namespace nrff
