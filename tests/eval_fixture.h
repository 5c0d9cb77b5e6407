// Images and the LPIPS network that tests of scoring share.
#pragma once

#include <filesystem>
#include <random>
#include <vector>

#include "eval/metrics.h"

namespace nrff {

inline RgbImage Constant(int width, int height, double value) {
  return {width, height, std::vector<double>(size_t(3) * width * height, value)};
}

inline RgbImage Noise(int width, int height, unsigned seed) {
  std::mt19937 random(seed);
  RgbImage image = Constant(width, height, 0);
  for (double& value : image.rgb) value = double(random()) / std::mt19937::max();
  return image;
}

// LPIPS of thirteen layers, as make_lpips_fixture.py writes it, small enough for the repository.
inline const std::filesystem::path kNarrow = std::filesystem::path(NRFF_SOURCE_DIR) / "tests/data/lpips_narrow.onnx";

}  // namespace nrff
