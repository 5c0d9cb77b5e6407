#include "sfm/working_photos.h"

#include <OpenImageIO/imageio.h>

#include <algorithm>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "sfm/photo_work.h"
#include "sfm/sensor_frame.h"
#include "sfm/undistort.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

// A camera to scale the photo with: only its size matters.
Lens PlainLens(int width, int height) {
  return Lens(
      {0, CameraModel::kSimplePinhole, width, height, {double(std::max(width, height)), width / 2.0, height / 2.0}});
}

// Composited onto the background; what does not count stays as it is, since features are found beside it.
void DropAlpha(Image& image, Masks masks, Background background) {
  if (image.channels == 3) return;
  if (masks == Masks::kIgnore) {
    image = WithoutAlpha(image);
    return;
  }
  const int behind = background == Background::kWhite ? 255 : 0;
  std::vector<uint8_t> rgb(image.pixels.size() / 4 * 3);
  for (size_t i = 0; i < rgb.size(); ++i) {
    const uint8_t* pixel = &image.pixels[i / 3 * 4];
    rgb[i] = uint8_t((pixel[i % 3] * pixel[3] + behind * (255 - pixel[3]) + 127) / 255);
  }
  image.pixels = std::move(rgb);
  image.channels = 3;
}

// White where at least half of a pixel counts.
Image MaskOf(const Image& image) {
  Image mask{image.width, image.height, 1, std::vector<uint8_t>(image.pixels.size() / 4)};
  for (size_t i = 0; i < mask.pixels.size(); ++i) mask.pixels[i] = image.pixels[4 * i + 3] >= 128 ? 255 : 0;
  return mask;
}

void WritePng(const Image& image, const fs::path& file) {
  const fs::path temporary = file.parent_path() / (file.stem().string() + ".partial.png");
  OIIO::ImageSpec spec(image.width, image.height, image.channels, OIIO::TypeDesc::UINT8);
  spec.attribute("png:compressionLevel", 1);  // soon deleted
  const auto output = OIIO::ImageOutput::create("png");
  const bool written = output && output->open(temporary.native(), spec) &&
                       output->write_image(OIIO::TypeDesc::UINT8, image.pixels.data()) && output->close();
  if (!written) {
    const std::string reason = output ? output->geterror() : OIIO::geterror();
    std::error_code ignored;
    fs::remove(temporary, ignored);
    throw ResourceError("cannot write " + EscapePath(file) + ": " + (reason.empty() ? "the disk may be full" : reason));
  }
  fs::rename(temporary, file);
}

}  // namespace

std::string WorkingPhotoName(const CaptureImage& photo) {
  return std::to_string(photo.camera) + "/" + photo.id + ".png";
}

fs::path MasksOfWorkingPhotos(const fs::path& dir) {
  fs::path masks = dir;
  return masks += "-masks";
}

std::string IdOfWorkingPhoto(const std::string& name) { return fs::path(name).stem().string(); }

std::pair<int, int> WorkingSize(int width, int height, int max_size) {
  const PinholeTarget target = ScaledTarget(PlainLens(width, height), max_size);
  return {target.width, target.height};
}

void WriteWorkingPhotos(const Capture& capture, int max_size, int n_threads, const fs::path& dir) {
  const fs::path masks = MasksOfWorkingPhotos(dir);
  for (const CaptureImage& photo : capture.images) {
    fs::create_directories((dir / WorkingPhotoName(photo)).parent_path());
    fs::create_directories((masks / WorkingPhotoName(photo)).parent_path());
  }
  ForEachPhoto("scaling photos", capture.images.size(), n_threads, [&](size_t i) {
    const CaptureImage& photo = capture.images[i];
    const fs::path file = dir / WorkingPhotoName(photo);
    if (fs::exists(file)) return;
    const Lens lens = PlainLens(photo.info.width, photo.info.height);
    Image image = ResampledPhoto(capture, photo, lens, ScaledTarget(lens, max_size));
    image = AsSensorHadIt(std::move(image), photo.info.orientation);
    if (image.channels == 4) WritePng(MaskOf(image), masks / (WorkingPhotoName(photo) + ".png"));
    DropAlpha(image, capture.masks, capture.background);
    WritePng(image, file);
  });
}

}  // namespace nrff
