#include "tests/test_photos.h"

#include <OpenImageIO/imageio.h>

#include <cstdio>
#include <memory>
#include <random>
#include <stdexcept>

#include "tests/program.h"

namespace nrff {

namespace fs = std::filesystem;

void WriteTestPhoto(const fs::path& path, const TestPhoto& photo) {
  constexpr int kBlock = 7;  // px
  std::mt19937 random(photo.seed);
  const int columns = photo.width / kBlock + 1, rows = photo.height / kBlock + 1;
  std::vector<uint8_t> blocks(3 * static_cast<size_t>(columns) * rows);
  for (uint8_t& value : blocks) value = static_cast<uint8_t>(random() >> 24);
  std::vector<uint8_t> pixels;
  for (int y = 0; y < photo.height; ++y) {
    for (int x = 0; x < photo.width; ++x) {
      const size_t block = 3 * (static_cast<size_t>(y / kBlock) * columns + x / kBlock);
      pixels.insert(pixels.end(), &blocks[block], &blocks[block] + 3);
    }
  }
  OIIO::ImageSpec spec(photo.width, photo.height, 3, OIIO::TypeDesc::UINT8);
  spec.attribute("Orientation", photo.orientation);
  const auto file = OIIO::ImageOutput::create(path.string());
  if (!file || !file->open(path.string(), spec) || !file->write_image(spec.format, pixels.data()) || !file->close()) {
    throw std::runtime_error("cannot write " + path.string());
  }
}

void WriteUnrelatedPhotos(const fs::path& dir, int n, int width, int height) {
  fs::create_directories(dir);
  for (int i = 0; i < n; ++i) {
    char name[16];
    std::snprintf(name, sizeof(name), "p%02d.jpg", i);
    WriteTestPhoto(dir / name, {.width = width, .height = height, .seed = static_cast<uint32_t>(i + 1)});
  }
}

void MakeExampleCapture(const fs::path& dir, const std::vector<std::string>& arguments) {
  std::vector<std::string> command = {"make_capture", "--out", dir.string(), "--quiet"};
  command.insert(command.end(), arguments.begin(), arguments.end());
  const ProgramResult result = RunProgram(command);
  if (result.exit_code != 0) throw std::runtime_error("make_capture failed: " + result.err);
}

}  // namespace nrff
