// Made-up photos for tests.
#pragma once

#include <OpenImageIO/imageio.h>

#include <algorithm>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "pipeline/files.h"

namespace nrff {

struct PhotoOptions {
  int width = 48, height = 32, channels = 3;
  int bit_depth = 8;
  uint32_t seed = 0;    // another texture for every seed
  int backdrop = -1;    // grey level of the outermost eighth on every side; < 0: texture there too
  uint8_t alpha = 128;  // of the left half, where there is an alpha channel; the right half is opaque
  std::function<void(OIIO::ImageSpec&)> metadata = [](OIIO::ImageSpec&) {};
};

// A value of the made-up texture: smooth enough for JPEG, different in every quadrant.
inline uint8_t TextureValue(const PhotoOptions& options, int x, int y, int channel) {
  const int margin = std::min(options.width, options.height) / 8;
  const bool outside = x < margin || y < margin || x >= options.width - margin || y >= options.height - margin;
  if (outside && options.backdrop >= 0) return uint8_t(options.backdrop);
  const uint32_t cell =
      static_cast<uint32_t>((x / 8) * 73856093 ^ (y / 8) * 19349663 ^ channel * 83492791) + options.seed * 2654435761u;
  return static_cast<uint8_t>((cell ^ (cell >> 13)) * 0x9E3779B1u >> 24);
}

// `format`: OpenImageIO's name ("jpeg", "png", …); the file's name may be anything.
inline void WritePhoto(const std::filesystem::path& path, const PhotoOptions& options = {},
                       const std::string& format = "png") {
  const OIIO::TypeDesc type = options.bit_depth == 8 ? OIIO::TypeDesc::UINT8 : OIIO::TypeDesc::UINT16;
  OIIO::ImageSpec spec(options.width, options.height, options.channels, type);
  const bool has_alpha = options.channels == 2 || options.channels == 4;
  if (has_alpha) {
    spec.alpha_channel = options.channels - 1;
    spec.attribute("oiio:UnassociatedAlpha", 1);
  }
  options.metadata(spec);
  std::vector<uint16_t> pixels;
  for (int y = 0; y < options.height; ++y) {
    for (int x = 0; x < options.width; ++x) {
      for (int c = 0; c < options.channels; ++c) {
        const bool is_alpha = has_alpha && c == options.channels - 1;
        const int value = !is_alpha ? TextureValue(options, x, y, c) : x < options.width / 2 ? options.alpha : 255;
        pixels.push_back(static_cast<uint16_t>(value * 257));  // 8 bits widened to 16
      }
    }
  }
  std::filesystem::create_directories(path.parent_path());
  const std::filesystem::path plain = path.parent_path() / "being-written";  // OpenImageIO gives some names a meaning
  const std::unique_ptr<OIIO::ImageOutput> file = OIIO::ImageOutput::create(format);
  if (!file || !file->open(plain.string(), spec) || !file->write_image(OIIO::TypeDesc::UINT16, pixels.data()) ||
      !file->close()) {
    throw std::runtime_error(path.string() + " could not be written: " + (file ? file->geterror() : OIIO::geterror()));
  }
  std::filesystem::rename(plain, path);
}

}  // namespace nrff
