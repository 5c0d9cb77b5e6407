// Small photos and captures for tests, made on the spot.
#pragma once

#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

namespace nrff {

struct TestPhoto {
  int width = 96, height = 64;  // px, of the stored raster
  uint32_t seed = 1;            // blocks of random colour; different seeds show nothing in common
  int orientation = 1;          // EXIF
};
// The format is that of the path's extension.
void WriteTestPhoto(const std::filesystem::path& path, const TestPhoto& photo);

// Writes `n` photos of nothing in common to `dir` (made if needed): p00.jpg, p01.jpg, …
void WriteUnrelatedPhotos(const std::filesystem::path& dir, int n, int width = 96, int height = 64);

// Runs make_capture with --out `dir` and these arguments. Throws when it fails.
void MakeExampleCapture(const std::filesystem::path& dir, const std::vector<std::string>& arguments);

}  // namespace nrff
