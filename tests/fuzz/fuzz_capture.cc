// capture.json of an ingest artifact.
#include <cmath>

#include "pipeline/files.h"
#include "sfm/capture.h"
#include "tests/fuzz/fuzz.h"

namespace nrff::fuzz {

std::vector<std::string> Seeds() {
  Capture capture;
  capture.name = "fox";
  capture.kind = "photos";
  capture.root = "/photos/fox \xFF";
  capture.split_rule = "every 8th by file name";
  capture.ordered = true;
  capture.box = {-1, -1, -1, 1, 1, 1};
  for (int i = 0; i < 2; ++i) {
    CaptureImage image;
    image.id = "00000" + std::to_string(i);
    image.path = "photo\n" + std::to_string(i) + ".jpg";
    image.info.width = 1080, image.info.height = 1920;
    image.info.make = "maker", image.info.model = "model";
    image.hash = "00";
    if (i == 0) {
      image.split = Split::kTest;
      image.info.focal_px = 1234.5;
      image.info.timestamp = "2012:04:21 10:11:12";
      image.info.exposure_seconds = 0.01, image.info.f_number = 2.8, image.info.iso = 100;
      image.info.gps = {{52.5, -13.4, 34}};
    }
    capture.images.push_back(image);
  }
  capture.rejected = {{"b.jpg", "is empty (0 bytes); copy it again"}};
  capture.duplicates = {{"a.jpg", "c.jpg"}};
  SaveCapture(capture, Folder());
  return {ReadFile(Folder() / kCaptureFile)};
}

}  // namespace nrff::fuzz

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace nrff;  // NOLINT(google-build-using-namespace)
  const auto& folder = fuzz::Folder();
  fuzz::Write(kCaptureFile, {reinterpret_cast<const char*>(data), size});
  const auto capture = fuzz::ParseOrError(folder / kCaptureFile, [&] { return LoadCapture(folder); });
  if (!capture) return 0;
  for (const CaptureImage& image : capture->images) {
    fuzz::Require(image.info.width > 0 && image.info.height > 0, "a photo has pixels");
    fuzz::Require(image.info.orientation >= 1 && image.info.orientation <= 8, "a photo's orientation is one of EXIF's");
    if (const auto& gps = image.info.gps) {
      fuzz::Require(std::abs(gps->latitude_deg) <= 90 && std::abs(gps->longitude_deg) <= 180, "a place is on earth");
    }
    fuzz::Require(!image.id.empty() && std::filesystem::path(image.id).filename() == image.id && image.id != "..",
                  "a photo's id is a file name");
  }
  SaveCapture(*capture, folder);
  const std::string written = ReadFile(folder / kCaptureFile);
  SaveCapture(LoadCapture(folder), folder);
  fuzz::Require(ReadFile(folder / kCaptureFile) == written, "a capture that is written is read as it was");
  return 0;
}
