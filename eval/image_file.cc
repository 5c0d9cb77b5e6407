#include "eval/image_file.h"

#include <OpenImageIO/imageio.h>

#include <algorithm>
#include <cmath>
#include <memory>
#include <string>

#include "pipeline/error.h"
#include "pipeline/files.h"

namespace nrff {
namespace {

template <typename Integer>
std::vector<double> ReadUnitValues(OIIO::ImageInput& file, OIIO::TypeDesc type, const std::string& where) {
  const OIIO::ImageSpec& spec = file.spec();
  std::vector<Integer> stored(size_t(spec.width) * spec.height * spec.nchannels);
  const bool read = file.read_image(0, 0, 0, spec.nchannels, type, stored.data());
  const std::string problem = file.geterror();  // a file that is cut short may be "read" all the same
  if (!read || !problem.empty()) {
    throw InputError("Image " + where + " is damaged (" + problem + "); make it again.");
  }
  constexpr double kMax = std::numeric_limits<Integer>::max();
  std::vector<double> values(stored.size());
  std::transform(stored.begin(), stored.end(), values.begin(), [](Integer value) { return value / kMax; });
  return values;
}

}  // namespace

StoredImage ReadImage(const std::filesystem::path& path) {
  const std::string where = EscapePath(path);
  OIIO::ImageSpec as_stored;
  as_stored["oiio:UnassociatedAlpha"] = 1;
  const std::unique_ptr<OIIO::ImageInput> file = OIIO::ImageInput::open(path.string(), &as_stored);
  if (!file) throw InputError("Image " + where + " cannot be opened (" + OIIO::geterror() + "); make it again.");
  const OIIO::ImageSpec& spec = file->spec();
  const bool sixteen = spec.format == OIIO::TypeDesc::UINT16;
  const int n_channels = spec.nchannels;
  if ((!sixteen && spec.format != OIIO::TypeDesc::UINT8) || n_channels < 1 || n_channels > 4) {
    throw InputError("Image " + where + " has " + std::to_string(n_channels) + " channels of type " +
                     spec.format.c_str() + "; expected grey or RGB, with or without alpha, of 8 or 16 bits.");
  }
  const int orientation = spec.get_int_attribute("Orientation", 1);
  if (orientation != 1) {
    throw InputError("Image " + where + " says that it is to be turned (EXIF orientation " +
                     std::to_string(orientation) + "); save it upright, without that note.");
  }
  const std::vector<double> values = sixteen ? ReadUnitValues<uint16_t>(*file, OIIO::TypeDesc::UINT16, where)
                                             : ReadUnitValues<uint8_t>(*file, OIIO::TypeDesc::UINT8, where);
  const size_t n_pixels = size_t(spec.width) * spec.height;
  const bool has_alpha = n_channels % 2 == 0;
  const int n_colours = has_alpha ? n_channels - 1 : n_channels;
  StoredImage image{{spec.width, spec.height, std::vector<double>(3 * n_pixels)},
                    std::vector<double>(has_alpha ? n_pixels : 0),
                    sixteen ? 16 : 8};
  // Some files hold colours that are multiplied by alpha already.
  const bool associated = has_alpha && spec.get_int_attribute("oiio:UnassociatedAlpha", 0) == 0;
  for (size_t i = 0; i < n_pixels; ++i) {
    const double* pixel = values.data() + i * n_channels;
    const double alpha = has_alpha ? pixel[n_colours] : 1;
    const double scale = associated && alpha > 0 ? 1 / alpha : 1;
    for (int c = 0; c < 3; ++c) image.rgb.rgb[3 * i + c] = scale * pixel[std::min(c, n_colours - 1)];
    if (has_alpha) image.alpha[i] = alpha;
  }
  return image;
}

RgbImage Composited(const StoredImage& image, Background background) {
  RgbImage composited = image.rgb;
  const double behind = background == Background::kWhite ? 1 : 0;
  for (size_t i = 0; i < image.alpha.size(); ++i) {
    for (int c = 0; c < 3; ++c) {
      double& value = composited.rgb[3 * i + c];
      value = value * image.alpha[i] + behind * (1 - image.alpha[i]);
    }
  }
  return composited;
}

std::vector<uint8_t> ToEightBits(const RgbImage& image) {
  std::vector<uint8_t> rgb(image.rgb.size());
  std::transform(image.rgb.begin(), image.rgb.end(), rgb.begin(),
                 [](double value) { return uint8_t(std::lround(std::clamp(value, 0.0, 1.0) * 255)); });
  return rgb;
}

void WriteRgbPng(const std::filesystem::path& path, int width, int height, const std::vector<uint8_t>& rgb) {
  const std::unique_ptr<OIIO::ImageOutput> file = OIIO::ImageOutput::create(path.string());
  const OIIO::ImageSpec spec(width, height, 3, OIIO::TypeDesc::UINT8);
  if (!file || !file->open(path.string(), spec) || !file->write_image(OIIO::TypeDesc::UINT8, rgb.data()) ||
      !file->close()) {
    throw ResourceError("Image " + EscapePath(path) + " cannot be written (" +
                        (file ? file->geterror() : OIIO::geterror()) + "); check the disk's space and permissions.");
  }
}

}  // namespace nrff
