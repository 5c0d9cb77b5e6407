// Photos: what ingest reads of a file's header, and the pixels where there are few.
#include <cmath>

#include "pipeline/files.h"
#include "sfm/image_io.h"
#include "tests/fuzz/fuzz.h"
#include "tests/photo_fixtures.h"

namespace nrff::fuzz {
namespace {

constexpr char kFile[] = "photo";
constexpr int64_t kMostPixels = 1 << 20;  // that are decoded

void RequireLaws(const ImageInfo& info) {
  const auto positive = [](const std::optional<double>& value) {
    return !value || (std::isfinite(*value) && *value > 0);
  };
  Require(info.width > 0 && info.height > 0, "a photo has pixels");
  Require(info.orientation >= 1 && info.orientation <= 8, "the orientation is one of EXIF's");
  Require(info.channels == 3 || info.channels == 4, "a photo has three channels or four");
  Require(info.bit_depth == 8 || info.bit_depth == 16, "a channel has 8 bits or 16");
  Require(positive(info.focal_px) && positive(info.exposure_seconds) && positive(info.f_number),
          "what EXIF says is finite and positive");
  Require(!info.gps || (std::abs(info.gps->latitude_deg) <= 90 && std::abs(info.gps->longitude_deg) <= 180),
          "a place is on earth");
  RequireText(info.make + info.model + info.timestamp.value_or(""), "");
}

}  // namespace

std::vector<std::string> Seeds() {
  PhotoOptions options{.width = 16, .height = 12};
  options.metadata = [](OIIO::ImageSpec& spec) {
    spec.attribute("Make", "maker");
    spec.attribute("Model", "model");
    spec.attribute("Orientation", 6);
    spec.attribute("DateTime", "2012:04:21 10:11:12");
    spec.attribute("Exif:DateTimeOriginal", "2012:04:21 10:11:12");
    spec.attribute("Exif:FocalLength", 4.2F);
    spec.attribute("Exif:FocalLengthIn35mmFilm", 28);
    spec.attribute("ExposureTime", 0.01F);
    spec.attribute("FNumber", 2.8F);
    spec.attribute("Exif:PhotographicSensitivity", 100);
  };
  std::vector<std::string> seeds;
  for (const char* format : {"jpeg", "png", "tiff", "webp"}) {
    for (const int channels : {1, 3, 4}) {
      options.channels = channels;
      options.bit_depth = channels == 4 && *format != 'w' ? 16 : 8;
      if ((*format == 'j' && channels == 4) || (*format == 'w' && channels == 1)) continue;
      WritePhoto(Folder() / kFile, options, format);
      seeds.push_back(ReadFile(Folder() / kFile));
    }
  }
  return seeds;
}

}  // namespace nrff::fuzz

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace nrff;  // NOLINT(google-build-using-namespace)
  const std::filesystem::path file = fuzz::Folder() / fuzz::kFile;
  fuzz::Write(fuzz::kFile, {reinterpret_cast<const char*>(data), size});
  const auto info = fuzz::ParseOrError(file, [&] { return ProbeImage(file); });
  if (!info) return 0;
  fuzz::RequireLaws(*info);
  if (int64_t{info->width} * info->height > fuzz::kMostPixels) return 0;
  const auto image = fuzz::ParseOrError(file, [&] { return ReadImageOriented(file); });
  if (!image) return 0;
  fuzz::Require(image->width == info->width && image->height == info->height, "the header says how large the photo is");
  fuzz::Require(image->pixels.size() == size_t(image->width) * image->height * image->channels, "all pixels are read");
  return 0;
}
