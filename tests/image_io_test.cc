#include "sfm/image_io.h"

#include <gmock/gmock.h>

#include <array>
#include <cmath>
#include <cstdlib>
#include <fstream>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/photo_name.h"
#include "tests/photo_fixtures.h"
#include "tests/temporary_directory.h"

namespace nrff {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;
namespace fs = std::filesystem;

class ImageIoTest : public ::testing::Test {
 protected:
  void Write(const fs::path& name, const std::string& bytes) {
    std::ofstream(dir_ / name, std::ios::binary | std::ios::trunc)
        .write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
  }

  std::string ErrorOf(const fs::path& name) {
    try {
      ProbeImage(dir_ / name);
      ReadImageOriented(dir_ / name);
    } catch (const Error& error) {
      EXPECT_EQ(error.code(), ExitCode::kInput);
      EXPECT_THAT(error.what(), HasSubstr(EscapePath(dir_ / name)));
      EXPECT_THAT(error.what(), Not(HasSubstr("/proc/")));
      EXPECT_THAT(error.what(), Not(HasSubstr("\n")));
      return error.what();
    }
    ADD_FAILURE() << name << " was read without an error";
    return {};
  }

  TemporaryDirectory holder_;
  const fs::path dir_ = holder_.path();
};

TEST_F(ImageIoTest, PixelsOfLosslessFormatsAreWhatWasWritten) {
  PhotoOptions options;
  for (const char* format : {"png", "tiff"}) {
    for (int bit_depth : {8, 16}) {
      options.bit_depth = bit_depth;
      WritePhoto(dir_ / "a", options, format);
      EXPECT_EQ(ProbeImage(dir_ / "a").bit_depth, bit_depth);
      const Image image = ReadImageOriented(dir_ / "a");
      ASSERT_EQ(image.width, 48);
      ASSERT_EQ(image.height, 32);
      ASSERT_EQ(image.channels, 3);
      for (int y = 0, i = 0; y < 32; ++y) {
        for (int x = 0; x < 48; ++x) {
          for (int c = 0; c < 3; ++c, ++i)
            ASSERT_EQ(image.pixels[i], TextureValue(options, x, y, c)) << format << bit_depth;
        }
      }
    }
  }
}

TEST_F(ImageIoTest, JpegAndWebpAreRead) {
  for (const char* format : {"jpeg", "webp"}) {
    WritePhoto(dir_ / "a", {}, format);
    const Image image = ReadImageOriented(dir_ / "a");
    EXPECT_EQ(image.width, 48);
    EXPECT_EQ(image.pixels.size(), 48u * 32 * 3);
    EXPECT_NEAR(image.pixels[0], TextureValue({}, 0, 0, 0), 60) << format;
  }
}

TEST_F(ImageIoTest, HeicIsReadWhereOpenImageIoHasIt) {
  if (!OIIO::ImageOutput::create("heif")) GTEST_SKIP() << "this OpenImageIO writes no HEIC to read";
  PhotoOptions options;
  options.width = 96;
  options.height = 64;
  // HEIC turns its pixels itself; EXIF's orientation is a leftover that must not turn them again.
  options.metadata = [](OIIO::ImageSpec& spec) { spec.attribute("Orientation", 6); };
  WritePhoto(dir_ / "a.heic", options, "heif");
  const ImageInfo info = ProbeImage(dir_ / "a.heic");
  const Image image = ReadImageOriented(dir_ / "a.heic");
  EXPECT_EQ(info.orientation, 1);
  EXPECT_EQ(info.width, 96);
  ASSERT_EQ(image.width, 96);
  ASSERT_EQ(image.height, 64);
  ASSERT_EQ(image.channels, 3);
  double error = 0;
  for (int y = 0, i = 0; y < 64; ++y) {
    for (int x = 0; x < 96; ++x) {
      for (int c = 0; c < 3; ++c, ++i) error += std::abs(image.pixels[i] - TextureValue(options, x, y, c));
    }
  }
  EXPECT_LT(error / double(image.pixels.size()), 30);  // lossy; another texture is 85 away
}

TEST_F(ImageIoTest, GreyBecomesRgb) {
  PhotoOptions options;
  options.channels = 1;
  WritePhoto(dir_ / "grey.png", options);
  EXPECT_EQ(ProbeImage(dir_ / "grey.png").channels, 3);
  const Image image = ReadImageOriented(dir_ / "grey.png");
  ASSERT_EQ(image.channels, 3);
  for (int c = 0; c < 3; ++c) EXPECT_EQ(image.pixels[c], TextureValue(options, 0, 0, 0));
}

TEST_F(ImageIoTest, AlphaStaysStraightAndIsDroppedWhereOpaque) {
  PhotoOptions options;
  options.channels = 4;
  for (const char* format : {"png", "tiff"}) {
    options.alpha = 128;
    WritePhoto(dir_ / "a", options, format);
    EXPECT_EQ(ProbeImage(dir_ / "a").channels, 4);
    const Image image = ReadImageOriented(dir_ / "a");
    ASSERT_EQ(image.channels, 4) << format;
    EXPECT_EQ(image.pixels[0], TextureValue(options, 0, 0, 0)) << format;
    EXPECT_EQ(image.pixels[3], 128);
    EXPECT_EQ(image.pixels[4 * 47 + 3], 255);
    options.alpha = 255;
    WritePhoto(dir_ / "a", options, format);
    EXPECT_EQ(ReadImageOriented(dir_ / "a").channels, 3);
  }
}

// Corner pixels of a 2×3 raster in all EXIF orientations, from the standard's definition: which corner of the stored
// raster is shown at the top left, and which at the top right.
TEST_F(ImageIoTest, AllEightOrientationsTurnTheRasterAsExifSays) {
  const Image stored{2, 3, 3, {1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4, 5, 5, 5, 6, 6, 6}};  // 12 / 34 / 56
  const std::vector<std::pair<int, std::string>> expected = {{1, "123456"}, {2, "214365"}, {3, "654321"},
                                                             {4, "563412"}, {5, "135246"}, {6, "531642"},
                                                             {7, "642531"}, {8, "246135"}};
  for (const auto& [orientation, shown] : expected) {
    const Image turned = Oriented(stored, orientation);
    EXPECT_EQ(turned.width, orientation < 5 ? 2 : 3);
    EXPECT_EQ(turned.height, orientation < 5 ? 3 : 2);
    std::string values;
    for (size_t i = 0; i < turned.pixels.size(); i += 3) values += static_cast<char>('0' + turned.pixels[i]);
    EXPECT_EQ(values, shown) << "orientation " << orientation;
  }
}

TEST_F(ImageIoTest, OrientationInTheFileIsAppliedOnceAndCanBeOverruled) {
  PhotoOptions options;
  for (int orientation = 1; orientation <= 8; ++orientation) {
    options.metadata = [&](OIIO::ImageSpec& spec) { spec.attribute("Orientation", orientation); };
    WritePhoto(dir_ / "a.jpg", options, "jpeg");
    const ImageInfo info = ProbeImage(dir_ / "a.jpg");
    EXPECT_EQ(info.orientation, orientation);
    const Image image = ReadImageOriented(dir_ / "a.jpg"), stored = ReadImageOriented(dir_ / "a.jpg", 1);
    EXPECT_EQ(info.width, orientation < 5 ? 48 : 32);
    EXPECT_EQ(image.width, info.width);
    EXPECT_EQ(image.height, info.height);
    EXPECT_EQ(image.pixels, Oriented(stored, orientation).pixels);
    EXPECT_EQ(stored.width, 48);
  }
}

TEST_F(ImageIoTest, ExifIsRead) {
  PhotoOptions options;
  options.metadata = [](OIIO::ImageSpec& spec) {
    spec.attribute("Make", "Maker ");
    spec.attribute("Model", "M1");
    spec.attribute("Exif:DateTimeOriginal", "2020:01:02 03:04:05");
    spec.attribute("ExposureTime", 0.3f);
    spec.attribute("FNumber", 4.0f);
    spec.attribute("Exif:PhotographicSensitivity", 200);
    spec.attribute("Exif:FocalLengthIn35mmFilm", 50);
  };
  WritePhoto(dir_ / "a.jpg", options, "jpeg");
  const ImageInfo info = ProbeImage(dir_ / "a.jpg");
  EXPECT_EQ(info.make, "Maker");
  EXPECT_EQ(info.model, "M1");
  EXPECT_EQ(info.timestamp, "2020:01:02 03:04:05");
  EXPECT_NEAR(info.exposure_seconds.value_or(0), 0.3, 1e-6);
  EXPECT_EQ(info.f_number, 4.0);
  EXPECT_EQ(info.iso, 200);
  ASSERT_TRUE(info.focal_px);
  // 48×32 has the film's shape: 50 mm of 36 mm width.
  EXPECT_NEAR(*info.focal_px, 50.0 / 36 * 48, 1e-9);
}

TEST_F(ImageIoTest, WhereAPhotoWasTakenIsRead) {
  const auto photo = [&](const char* ns, const char* ew, std::array<float, 3> latitude) {
    PhotoOptions options;
    options.metadata = [&](OIIO::ImageSpec& spec) {
      const OIIO::TypeDesc three(OIIO::TypeDesc::FLOAT, 3);
      const std::array<float, 3> longitude = {13, 24, 36};
      spec.attribute("GPS:Latitude", three, latitude.data());
      spec.attribute("GPS:Longitude", three, longitude.data());
      if (*ns) spec.attribute("GPS:LatitudeRef", ns);
      spec.attribute("GPS:LongitudeRef", ew);
      spec.attribute("GPS:Altitude", 34.5f);
    };
    WritePhoto(dir_ / "a.jpg", options, "jpeg");
    return ProbeImage(dir_ / "a.jpg").gps;
  };
  const auto north_east = photo("N", "E", {52, 30, 0}), south_west = photo("S", "W", {52, 30, 0});
  ASSERT_TRUE(north_east && south_west);
  EXPECT_NEAR(north_east->latitude_deg, 52.5, 1e-6);
  EXPECT_NEAR(north_east->longitude_deg, 13.41, 1e-6);
  EXPECT_NEAR(north_east->altitude_m.value_or(0), 34.5, 1e-4);
  EXPECT_NEAR(south_west->latitude_deg, -52.5, 1e-6);
  EXPECT_NEAR(south_west->longitude_deg, -13.41, 1e-6);
  EXPECT_FALSE(photo("N", "E", {97, 0, 0}));  // beyond the pole
  EXPECT_FALSE(photo("", "E", {52, 30, 0}));
  WritePhoto(dir_ / "b.jpg", {}, "jpeg");
  EXPECT_FALSE(ProbeImage(dir_ / "b.jpg").gps);
}

TEST_F(ImageIoTest, FocalLengthFromThePhysicalPixelPitchFollowsResizing) {
  PhotoOptions options;
  options.metadata = [](OIIO::ImageSpec& spec) {
    spec.attribute("Exif:FocalLength", 10.0f);             // mm
    spec.attribute("Exif:FocalPlaneXResolution", 100.0f);  // per cm: 10 px per mm
    spec.attribute("Exif:FocalPlaneResolutionUnit", 3);
    spec.attribute("Exif:PixelXDimension", 96);  // the photo was taken at twice the size
  };
  WritePhoto(dir_ / "a.jpg", options, "jpeg");
  const ImageInfo info = ProbeImage(dir_ / "a.jpg");
  ASSERT_TRUE(info.focal_px);
  EXPECT_NEAR(*info.focal_px, 50, 1e-4);
}

TEST_F(ImageIoTest, NoExifIsNoError) {
  WritePhoto(dir_ / "a.png");
  const ImageInfo info = ProbeImage(dir_ / "a.png");
  EXPECT_FALSE(info.focal_px);
  EXPECT_FALSE(info.timestamp);
  EXPECT_EQ(info.make, "");
}

TEST_F(ImageIoTest, FilesCutAnywhereAreErrors) {
  PhotoOptions options;
  options.width = options.height = 128;
  for (const char* format : {"jpeg", "png", "tiff", "webp"}) {
    WritePhoto(dir_ / "whole", options, format);
    const std::string whole = ReadFile(dir_ / "whole");
    ReadImageOriented(dir_ / "whole");
    for (size_t percent : {1, 3, 10, 30, 50, 70, 90, 97}) {
      Write("cut", whole.substr(0, whole.size() * percent / 100));
      EXPECT_NE(ErrorOf("cut"), "") << format << " cut to " << percent << " %";
    }
  }
}

TEST_F(ImageIoTest, EmptyAndForeignFilesAreErrorsThatSayWhatWasFound) {
  Write("zero.jpg", "");
  EXPECT_THAT(ErrorOf("zero.jpg"), HasSubstr("is empty"));
  Write("text.jpg", "hello, this is text");
  EXPECT_THAT(ErrorOf("text.jpg"), HasSubstr("hello, this"));
  EXPECT_THAT(ErrorOf("absent.jpg"), HasSubstr("cannot be read"));
}

TEST_F(ImageIoTest, TheFormatIsToldFromTheContentNotTheName) {
  WritePhoto(dir_ / "really_png.jpg");
  EXPECT_EQ(ReadImageOriented(dir_ / "really_png.jpg").width, 48);
}

TEST_F(ImageIoTest, AbsurdSizesAreRefusedBeforeMemoryIsTaken) {
  WritePhoto(dir_ / "a.png");
  std::string bytes = ReadFile(dir_ / "a.png");
  bytes.replace(
      16, 8, std::string("\x00\x0f\x00\x00\x00\x0f\x00\x00", 8));  // IHDR's width and height; its CRC is now wrong, too
  Write("huge.png", bytes);
  ErrorOf("huge.png");
  WritePhoto(dir_ / "a.jpg", {}, "jpeg");
  bytes = ReadFile(dir_ / "a.jpg");
  const size_t frame = bytes.find("\xff\xc0");
  ASSERT_NE(frame, std::string::npos);
  bytes.replace(frame + 5, 4, "\xff\x00\xff\x00", 4);
  Write("huge.jpg", bytes);
  EXPECT_THAT(ErrorOf("huge.jpg"), HasSubstr("65280×65280"));
}

TEST_F(ImageIoTest, NamesMayHoldAnyByte) {
  for (const char* name :
       {"with space.png", "new\nline.png", "quo\"te's.png", "not-utf8-\xff\xfe.png", "a?b=c#d%20.png", "<UDIM>.png"}) {
    WritePhoto(dir_ / name);
    EXPECT_EQ(ProbeImage(dir_ / name).width, 48) << EscapePath(name);
    EXPECT_EQ(ReadImageOriented(dir_ / name).width, 48) << EscapePath(name);
  }
}

TEST_F(ImageIoTest, PhotoExtensionsAreToldInAnyCase) {
  for (const char* name : {"a.jpg", "a.JPG", "a.JpEg", "a.png", "a.TIF", "a.tiff", "a.webp", "a.HEIC"})
    EXPECT_TRUE(HasPhotoExtension(name)) << name;
  for (const char* name : {"a.txt", "jpg", "a.jpg.txt", "a", "a.json"}) EXPECT_FALSE(HasPhotoExtension(name)) << name;
}

}  // namespace
}  // namespace nrff
