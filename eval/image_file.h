// Image files as evaluation reads and writes them.
#pragma once

#include <cstdint>
#include <filesystem>
#include <vector>

#include "eval/metrics.h"
#include "pipeline/scene.h"

namespace nrff {

struct StoredImage {
  RgbImage rgb;               // straight, as stored, in [0, 1]
  std::vector<double> alpha;  // [height, width] in [0, 1]; empty: opaque
  int bits = 8;               // a channel: 8 or 16
};

// Grey becomes RGB. Throws InputError naming the file: absent, damaged, cut short, not 1 to 4 channels of 8 or 16 bits.
StoredImage ReadImage(const std::filesystem::path& path);

// RGB over a background of black or white, not rounded. The background of an opaque image does not matter.
RgbImage Composited(const StoredImage& image, Background background);

// [height, width, 3], rounded to 8 bits.
std::vector<uint8_t> ToEightBits(const RgbImage& image);

// Throws ResourceError naming the file.
void WriteRgbPng(const std::filesystem::path& path, int width, int height, const std::vector<uint8_t>& rgb);

}  // namespace nrff
