#include "eval/png.h"

#include <OpenImageIO/imageio.h>

#include <memory>
#include <string>

#include "pipeline/error.h"
#include "pipeline/files.h"

namespace nrff {

Rgb8Image ReadRgbPng(const std::filesystem::path& path) {
  const std::unique_ptr<OIIO::ImageInput> file = OIIO::ImageInput::open(path.string());
  if (!file) {
    throw InputError("Image " + EscapePath(path) + " cannot be opened (" + OIIO::geterror() +
                     "); render the views again.");
  }
  const OIIO::ImageSpec& spec = file->spec();
  if (spec.nchannels != 3 || spec.format != OIIO::TypeDesc::UINT8) {
    throw InputError("Image " + EscapePath(path) + " has " + std::to_string(spec.nchannels) + " channels of type " +
                     spec.format.c_str() + "; expected three of 8 bits. Render the views again.");
  }
  Rgb8Image image{spec.width, spec.height, std::vector<uint8_t>(spec.image_bytes())};
  const bool read = file->read_image(0, 0, 0, 3, OIIO::TypeDesc::UINT8, image.rgb.data());
  const std::string problem = file->geterror();  // a file that is cut short may be "read" all the same
  if (!read || !problem.empty()) {
    throw InputError("Image " + EscapePath(path) + " is damaged (" + problem + "); render the views again.");
  }
  return image;
}

void WriteRgbPng(const std::filesystem::path& path, const Rgb8Image& image) {
  const std::unique_ptr<OIIO::ImageOutput> file = OIIO::ImageOutput::create(path.string());
  const OIIO::ImageSpec spec(image.width, image.height, 3, OIIO::TypeDesc::UINT8);
  if (!file || !file->open(path.string(), spec) || !file->write_image(OIIO::TypeDesc::UINT8, image.rgb.data()) ||
      !file->close()) {
    throw ResourceError("Image " + EscapePath(path) + " cannot be written (" +
                        (file ? file->geterror() : OIIO::geterror()) + "); check the disk's space and permissions.");
  }
}

}  // namespace nrff
