#include "render/png.h"

#include <png.h>

#include <bit>
#include <string>

#include "pipeline/error.h"
#include "pipeline/files.h"

namespace nrff {
namespace {

// libpng's structures, freed whatever happens.
struct PngWriter {
  png_structp png = nullptr;
  png_infop info = nullptr;
  PngWriter() = default;
  PngWriter(const PngWriter&) = delete;
  PngWriter& operator=(const PngWriter&) = delete;
  ~PngWriter() { png_destroy_write_struct(&png, &info); }
};

[[noreturn]] void ThrowPngError(png_structp /*png*/, png_const_charp message) {
  throw ResourceError(std::string("libpng cannot encode an image: ") + message);
}

int ColorType(int channels) {
  return channels == 1 ? PNG_COLOR_TYPE_GRAY : channels == 3 ? PNG_COLOR_TYPE_RGB : PNG_COLOR_TYPE_RGB_ALPHA;
}

template <typename Sample>
std::string EncodePng(int width, int height, int channels, const std::vector<Sample>& data) {
  PngWriter writer;
  // Errors leave as C++ exceptions: libpng is compiled to be unwound through on this platform, and no setjmp is needed.
  writer.png = png_create_write_struct(PNG_LIBPNG_VER_STRING, nullptr, ThrowPngError, nullptr);
  if (writer.png == nullptr)
    throw ResourceError("libpng cannot be started: the header's and the library's versions differ");
  writer.info = png_create_info_struct(writer.png);
  std::string bytes;
  png_set_write_fn(
      writer.png, &bytes,
      [](png_structp png, png_bytep chunk, size_t n) {
        static_cast<std::string*>(png_get_io_ptr(png))->append(reinterpret_cast<const char*>(chunk), n);
      },
      nullptr);
  png_set_IHDR(writer.png, writer.info, width, height, 8 * sizeof(Sample), ColorType(channels), PNG_INTERLACE_NONE,
               PNG_COMPRESSION_TYPE_DEFAULT, PNG_FILTER_TYPE_DEFAULT);
  png_set_compression_level(writer.png, 4);  // a third of the default's time for a few per cent of size
  png_write_info(writer.png, writer.info);
  if (sizeof(Sample) == 2 && std::endian::native == std::endian::little) png_set_swap(writer.png);
  const size_t row_samples = static_cast<size_t>(width) * channels;
  for (int y = 0; y < height; ++y) {
    png_write_row(writer.png, reinterpret_cast<png_const_bytep>(data.data() + y * row_samples));
  }
  png_write_end(writer.png, writer.info);
  return bytes;
}

template <typename Sample>
void Write(const std::filesystem::path& path, int width, int height, int channels, const std::vector<Sample>& data) {
  const bool known = channels == 1 || channels == 3 || channels == 4;
  if (width <= 0 || height <= 0 || !known || data.size() != static_cast<size_t>(width) * height * channels) {
    throw InputError("an image of " + std::to_string(width) + "×" + std::to_string(height) + " px with " +
                     std::to_string(channels) + " channels and " + std::to_string(data.size()) +
                     " values cannot be written to " + EscapePath(path) +
                     "; expected width × height × (1, 3 or 4) values");
  }
  WriteFileAtomically(path, EncodePng(width, height, channels, data));
}

}  // namespace

void WritePng(const std::filesystem::path& path, int width, int height, int channels,
              const std::vector<uint8_t>& data) {
  Write(path, width, height, channels, data);
}

void WritePng(const std::filesystem::path& path, int width, int height, int channels,
              const std::vector<uint16_t>& data) {
  Write(path, width, height, channels, data);
}

}  // namespace nrff
