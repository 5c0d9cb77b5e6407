// Reading photos: what a file says about itself, and its pixels with the EXIF orientation applied.
//
// The format is told from the file's first bytes, not from its name: JPEG, PNG, TIFF, WebP, HEIF (where OpenImageIO was
// built with it). File names may hold any bytes. Errors are InputError: "<file>: <what was found and what to do>".
#pragma once

#include <cstdint>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

namespace nrff {

struct Image {
  int width = 0, height = 0;    // px
  int channels = 3;             // 3 RGB, 4 RGBA (straight alpha)
  std::vector<uint8_t> pixels;  // height × width × channels, row-major, sRGB
};

// By satellite, WGS 84.
struct GpsPosition {
  double latitude_deg = 0, longitude_deg = 0;  // north and east positive
  std::optional<double> altitude_m;            // above the sea
};

struct ImageInfo {
  int width = 0, height = 0;  // px, after orientation
  int orientation = 1;        // EXIF, 1 to 8: how the stored raster is turned for display
  int channels = 3;           // 4 if the file has an alpha channel
  int bit_depth = 8;          // 8 or 16
  // Focal length in px of the stored raster (the same along both axes), the first of these that the EXIF data allows:
  //   f35 · √(w² + h²) / √(36² + 24²)       f35 = FocalLengthIn35mmFilm [mm]: equal diagonal angle (CIPA DCG-001)
  //   f · R / u · w / w0                     f = FocalLength [mm], R = FocalPlaneXResolution [px per unit], u = length
  //   of
  //                                          FocalPlaneResolutionUnit [mm], w0 = PixelXDimension, the width R refers to
  std::optional<double> focal_px;
  std::string make, model;               // escaped (EscapePath), empty if not given
  std::optional<std::string> timestamp;  // DateTimeOriginal, else DateTime: "2012:04:21 10:11:12"
  std::optional<double> exposure_seconds, f_number;
  std::optional<int> iso;
  std::optional<GpsPosition> gps;
};

// Reads the header only: the pixels may still turn out to be damaged.
ImageInfo ProbeImage(const std::filesystem::path& path);

// Decodes to 8-bit sRGB: grey becomes RGB, 16 bits are rounded to 8, an alpha channel that is opaque everywhere is
// dropped, and the raster is turned as its EXIF orientation says, or as `orientation` says where that is given.
// Truncated and damaged files are errors even where the decoder fills in what is missing.
Image ReadImageOriented(const std::filesystem::path& path, std::optional<int> orientation = {});

// Turns a stored raster for display as EXIF orientation 1 to 8 says.
Image Oriented(Image stored, int orientation);

}  // namespace nrff
