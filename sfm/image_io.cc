#include "sfm/image_io.h"

#include <OpenImageIO/imageio.h>
#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <memory>
#include <string_view>
#include <utility>

#include "pipeline/error.h"
#include "pipeline/files.h"

namespace nrff {
namespace {

// A header can claim any size; what no camera makes is refused before memory is taken.
constexpr int64_t kMaxPixels = int64_t{1} << 29;
constexpr int64_t kMaxPixelsPerByte = 1 << 16;  // of the file: hundreds are what a black photo comes to

// The file is handed to OpenImageIO as /proc/self/fd/N: its own handling of names gives '?' and '#' a meaning.
class OpenFile {
 public:
  explicit OpenFile(const std::filesystem::path& path)
      : name_(EscapePath(path)), fd_(open(path.c_str(), O_RDONLY | O_CLOEXEC)) {
    if (fd_ < 0) throw Error("cannot be read; check that it exists and its permissions");
  }
  ~OpenFile() { close(fd_); }
  OpenFile(const OpenFile&) = delete;
  OpenFile& operator=(const OpenFile&) = delete;

  nrff::Error Error(const std::string& what) const { return InputError(name_ + ": " + what); }
  std::string Path() const { return "/proc/self/fd/" + std::to_string(fd_); }

  int64_t SizeBytes() const {
    struct stat info {};
    return fstat(fd_, &info) == 0 ? info.st_size : 0;
  }

  // Of a PNG: libpng takes, and fills, as much memory as a chunk says it is long before it looks for the bytes. Pixels
  // (IDAT) it reads piece by piece, and says itself what is missing.
  void CheckPngChunks() const {
    constexpr int64_t kSignatureBytes = 8, kChecksumBytes = 4;
    const int64_t n_bytes = SizeBytes();
    std::array<uint8_t, 8> head{};  // length, big-endian, and name
    for (int64_t at = kSignatureBytes; pread(fd_, head.data(), head.size(), at) == static_cast<ssize_t>(head.size());) {
      const int64_t length = int64_t{head[0]} << 24 | head[1] << 16 | head[2] << 8 | head[3];
      const std::string_view name(reinterpret_cast<const char*>(&head[4]), 4);
      at += static_cast<ssize_t>(head.size());
      if (length > n_bytes - at && name != "IDAT") {
        throw Error("is truncated or damaged (a chunk of " + std::to_string(length) + " bytes where " +
                    std::to_string(n_bytes - at) + " are left); copy it again");
      }
      at += length + kChecksumBytes;
    }
  }

  // OpenImageIO's name of the format that the first bytes belong to.
  const char* Format() const {
    std::array<char, 12> head{};
    const ssize_t n = pread(fd_, head.data(), head.size(), 0);
    if (n < 0) throw Error("cannot be read");
    if (n == 0) throw Error("is empty (0 bytes); copy it again");
    const std::string_view start(head.data(), n);
    if (start.starts_with("\xff\xd8\xff")) return "jpeg";
    if (start.starts_with("\x89PNG\r\n\x1a\n")) return "png";
    if (start.starts_with(std::string_view("II*\0", 4)) || start.starts_with(std::string_view("MM\0*", 4)) ||
        start.starts_with(std::string_view("II+\0", 4)) || start.starts_with(std::string_view("MM\0+", 4))) {
      return "tiff";
    }
    if (start.starts_with("RIFF") && start.substr(std::min<size_t>(8, n)) == "WEBP") return "webp";
    if (start.substr(std::min<size_t>(4, n)).starts_with("ftyp")) return "heif";
    throw Error("is not a photo: its first bytes are \"" + EscapePath(std::string(start)) +
                "\"; expected JPEG, PNG, TIFF, WebP or HEIF");
  }

 private:
  std::string name_;
  int fd_;
};

class Decoder {
 public:
  explicit Decoder(const std::filesystem::path& path) : file_(path) {
    const char* format = file_.Format();
    if (std::string_view(format) == "png") file_.CheckPngChunks();
    input_ = OIIO::ImageInput::create(format);
    if (!input_) {
      OIIO::geterror();
      throw file_.Error(std::string("is a ") + format +
                        " file, which OpenImageIO was built without; convert it to JPEG or PNG");
    }
    OIIO::ImageSpec config;
    config.attribute("oiio:UnassociatedAlpha", 1);  // straight alpha: premultiplying in 8 bits loses colour
    if (!input_->open(file_.Path(), spec_, config)) throw Damaged();
    if (spec_.width <= 0 || spec_.height <= 0 || int64_t{spec_.width} * spec_.height > kMaxPixels) {
      throw file_.Error("claims " + std::to_string(spec_.width) + "×" + std::to_string(spec_.height) +
                        " px; more than 2^29 pixels are taken for damage");
    }
    if (int64_t{spec_.width} * spec_.height > file_.SizeBytes() * kMaxPixelsPerByte) {
      throw file_.Error("claims " + std::to_string(spec_.width) + "×" + std::to_string(spec_.height) + " px in " +
                        std::to_string(file_.SizeBytes()) + " bytes, which cannot hold them; copy it again");
    }
    const bool alpha_last = spec_.alpha_channel == spec_.nchannels - 1;
    if (!(spec_.nchannels == 1 || spec_.nchannels == 3 ||
          ((spec_.nchannels == 2 || spec_.nchannels == 4) && alpha_last))) {
      throw file_.Error("has " + std::to_string(spec_.nchannels) +
                        " channels; expected grey or RGB, with or without alpha");
    }
    if (spec_.format != OIIO::TypeUInt8 && spec_.format != OIIO::TypeUInt16) {
      throw file_.Error(std::string("has pixels of type ") + spec_.format.c_str() +
                        "; expected 8 or 16 bits a channel");
    }
  }

  const OIIO::ImageSpec& spec() const { return spec_; }

  template <typename T>
  std::vector<T> Pixels() {
    std::vector<T> pixels(static_cast<size_t>(spec_.width) * spec_.height * spec_.nchannels);
    const bool read = input_->read_image(0, 0, 0, spec_.nchannels, OIIO::BaseTypeFromC<T>::value, pixels.data());
    const std::string message = input_->geterror();
    // libjpeg fills what a truncated file lacks and only leaves a message. Bytes too many between two markers, which
    // some cameras write, are no loss.
    if (!read || (!message.empty() && message.find("extraneous bytes") == std::string::npos)) throw Damaged(message);
    return pixels;
  }

 private:
  nrff::Error Damaged() { return Damaged(input_->geterror()); }
  nrff::Error Damaged(std::string message) {
    // The decoders name the descriptor and take several lines.
    for (const std::string& noise : {" (\"" + file_.Path() + "\")", " for \"" + file_.Path() + "\"", file_.Path()}) {
      for (size_t at; (at = message.find(noise)) != std::string::npos;) message.erase(at, noise.size());
    }
    message.resize(message.find_last_not_of("\n.") + 1);
    for (size_t at; (at = message.find('\n')) != std::string::npos;) message.replace(at, 1, "; ");
    if (message.empty()) message = "the decoder gave up";
    return file_.Error("is truncated or damaged (" + message + "); copy it again");
  }

  OpenFile file_;
  std::unique_ptr<OIIO::ImageInput> input_;
  OIIO::ImageSpec spec_;
};

int StoredOrientation(const OIIO::ImageSpec& spec) {
  const int orientation = spec.get_int_attribute("Orientation", 1);
  return orientation >= 1 && orientation <= 8 ? orientation : 1;
}

bool SwapsAxes(int orientation) { return orientation >= 5; }

std::optional<double> Positive(const OIIO::ImageSpec& spec, const char* name) {
  const float value = spec.get_float_attribute(name, 0);
  if (!std::isfinite(value) || value <= 0) return {};
  return value;
}

std::optional<double> FocalLength_px(const OIIO::ImageSpec& spec) {
  if (auto f35 = Positive(spec, "Exif:FocalLengthIn35mmFilm")) {
    return *f35 * std::hypot(spec.width, spec.height) / std::hypot(36, 24);
  }
  const auto focal_mm = Positive(spec, "Exif:FocalLength");
  const auto resolution = Positive(spec, "Exif:FocalPlaneXResolution");
  if (!focal_mm || !resolution) return {};
  double unit_mm = 25.4;  // 2, inch, is also EXIF's default
  switch (spec.get_int_attribute("Exif:FocalPlaneResolutionUnit", 2)) {
    case 3:
      unit_mm = 10;
      break;
    case 4:
      unit_mm = 1;
      break;
    case 5:
      unit_mm = 1e-3;
      break;
  }
  const double full_width = Positive(spec, "Exif:PixelXDimension").value_or(spec.width);
  const double focal_px = *focal_mm * *resolution / unit_mm * spec.width / full_width;
  // Outside of what lenses do (150° to 1°) the tags contradict each other, as after careless resizing.
  const double side = std::max(spec.width, spec.height);
  if (focal_px < 0.13 * side || focal_px > 57 * side) return {};
  return focal_px;
}

std::string Text(const OIIO::ImageSpec& spec, const char* name) {
  std::string text = spec.get_string_attribute(name);
  text.resize(text.find_last_not_of(std::string_view(" \0", 2)) + 1);
  return EscapePath(text);
}

// Degrees, minutes and seconds; negative where the reference is `negative` (S or W).
std::optional<double> GpsAngle_deg(const OIIO::ImageSpec& spec, const std::string& name, char negative, double most) {
  const OIIO::ParamValue* parts = spec.find_attribute(name);
  const std::string reference = spec.get_string_attribute(name + "Ref");
  if (!parts || parts->type().basetype != OIIO::TypeDesc::FLOAT || parts->type().numelements() != 3) return {};
  const double angle =
      parts->get_float_indexed(0) + parts->get_float_indexed(1) / 60. + parts->get_float_indexed(2) / 3600.;
  if (!(angle >= 0 && angle <= most) || reference.empty()) return {};
  return reference.front() == negative ? -angle : angle;
}

std::optional<GpsPosition> Gps(const OIIO::ImageSpec& spec) {
  const auto latitude = GpsAngle_deg(spec, "GPS:Latitude", 'S', 90),
             longitude = GpsAngle_deg(spec, "GPS:Longitude", 'W', 180);
  if (!latitude || !longitude) return {};
  GpsPosition position{*latitude, *longitude, {}};
  const double altitude = spec.get_float_attribute("GPS:Altitude", NAN);
  const bool below_sea = spec.get_int_attribute("GPS:AltitudeRef", 0) == 1;
  if (std::isfinite(altitude)) position.altitude_m = below_sea ? -altitude : altitude;
  return position;
}

Image ToEightBits(Decoder& decoder) {
  const OIIO::ImageSpec& spec = decoder.spec();
  Image image{spec.width, spec.height, spec.nchannels, {}};
  if (spec.format == OIIO::TypeUInt8) {
    image.pixels = decoder.Pixels<uint8_t>();
  } else {
    const std::vector<uint16_t> wide = decoder.Pixels<uint16_t>();
    image.pixels.resize(wide.size());
    std::transform(wide.begin(), wide.end(), image.pixels.begin(),
                   [](uint16_t value) { return static_cast<uint8_t>((value * 255u + 32767u) / 65535u); });
  }
  return image;
}

// Files whose alpha is premultiplied (TIFF can say so) are brought to straight alpha.
void Unpremultiply(Image& image) {
  const int n = image.channels;
  for (size_t at = 0; at < image.pixels.size(); at += n) {
    const int alpha = image.pixels[at + n - 1];
    if (alpha == 0) continue;
    for (int c = 0; c < n - 1; ++c) {
      image.pixels[at + c] = static_cast<uint8_t>(std::min(255, (image.pixels[at + c] * 255 + alpha / 2) / alpha));
    }
  }
}

bool IsOpaque(const Image& image) {
  for (size_t at = image.channels - 1; at < image.pixels.size(); at += image.channels) {
    if (image.pixels[at] != 255) return false;
  }
  return true;
}

// 1 to 4 channels → RGB, or RGBA where some pixel is not opaque.
Image ToColour(Image image) {
  const bool has_alpha = image.channels == 2 || image.channels == 4;
  const bool is_grey = image.channels <= 2;
  const int channels = has_alpha && !IsOpaque(image) ? 4 : 3;
  if (channels == image.channels) return image;
  Image colour{image.width, image.height, channels, {}};
  const size_t n_pixels = static_cast<size_t>(image.width) * image.height;
  colour.pixels.resize(n_pixels * channels);
  for (size_t i = 0; i < n_pixels; ++i) {
    const uint8_t* from = &image.pixels[i * image.channels];
    uint8_t* to = &colour.pixels[i * channels];
    for (int c = 0; c < 3; ++c) to[c] = from[is_grey ? 0 : c];
    if (channels == 4) to[3] = from[image.channels - 1];
  }
  return colour;
}

}  // namespace

Image Oriented(Image stored, int orientation) {
  if (orientation == 1) return stored;
  const int w = stored.width, h = stored.height, n = stored.channels;
  Image turned = SwapsAxes(orientation) ? Image{h, w, n, {}} : Image{w, h, n, {}};
  turned.pixels.resize(stored.pixels.size());
  const bool mirror_x = orientation == 2 || orientation == 3 || orientation == 7 || orientation == 8;
  const bool mirror_y = orientation == 3 || orientation == 4 || orientation == 6 || orientation == 7;
  for (int y = 0; y < turned.height; ++y) {
    for (int x = 0; x < turned.width; ++x) {
      int from_x = SwapsAxes(orientation) ? y : x;
      int from_y = SwapsAxes(orientation) ? x : y;
      if (mirror_x) from_x = w - 1 - from_x;
      if (mirror_y) from_y = h - 1 - from_y;
      std::copy_n(&stored.pixels[(static_cast<size_t>(from_y) * w + from_x) * n], n,
                  &turned.pixels[(static_cast<size_t>(y) * turned.width + x) * n]);
    }
  }
  return turned;
}

ImageInfo ProbeImage(const std::filesystem::path& path) {
  const Decoder decoder(path);
  const OIIO::ImageSpec& spec = decoder.spec();
  ImageInfo info;
  info.orientation = StoredOrientation(spec);
  info.width = SwapsAxes(info.orientation) ? spec.height : spec.width;
  info.height = SwapsAxes(info.orientation) ? spec.width : spec.height;
  info.channels = spec.alpha_channel >= 0 ? 4 : 3;
  info.bit_depth = spec.format == OIIO::TypeUInt8 ? 8 : 16;
  info.focal_px = FocalLength_px(spec);
  info.make = Text(spec, "Make");
  info.model = Text(spec, "Model");
  for (const char* name : {"Exif:DateTimeOriginal", "DateTime"}) {
    if (std::string time = Text(spec, name); !time.empty() && !info.timestamp) info.timestamp = std::move(time);
  }
  info.exposure_seconds = Positive(spec, "ExposureTime");
  info.f_number = Positive(spec, "FNumber");
  for (const char* name : {"Exif:PhotographicSensitivity", "Exif:ISOSpeedRatings"}) {
    if (const int iso = spec.get_int_attribute(name, 0); iso > 0) info.iso = iso;
  }
  info.gps = Gps(spec);
  return info;
}

Image ReadImageOriented(const std::filesystem::path& path, std::optional<int> orientation) {
  Decoder decoder(path);
  Image image = ToEightBits(decoder);
  const bool premultiplied =
      decoder.spec().alpha_channel >= 0 && !decoder.spec().get_int_attribute("oiio:UnassociatedAlpha");
  if (premultiplied) Unpremultiply(image);
  return Oriented(ToColour(std::move(image)), orientation.value_or(StoredOrientation(decoder.spec())));
}

}  // namespace nrff
