// Masks: which file is whose, what is wrong with one, and what becomes of the pixels that they leave out.
#include "sfm/masks.h"

#include <fstream>

#include "sfm/photo_work.h"
#include "sfm/working_photos.h"
#include "tests/ingest_fixture.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;
using ::testing::HasSubstr;

class MasksTest : public IngestTest {
 protected:
  // The left half of a photo does not count.
  void WriteMask(const std::string& name, int width = 48, int height = 32, int black_columns = 24) {
    fs::create_directories((root_ / name).parent_path());
    Image image{width, height, 1, std::vector<uint8_t>(size_t(width) * size_t(height), 255)};
    for (size_t i = 0; i < image.pixels.size(); ++i) {
      if (int(i) % width < black_columns) image.pixels[i] = 0;
    }
    const auto file = OIIO::ImageOutput::create("png");
    ASSERT_TRUE(file && file->open((root_ / name).string(), OIIO::ImageSpec(width, height, 1, OIIO::TypeDesc::UINT8)) &&
                file->write_image(OIIO::TypeDesc::UINT8, image.pixels.data()) && file->close());
  }

  static std::vector<std::string> MasksOf(const Capture& capture) {
    std::vector<std::string> masks;
    for (const CaptureImage& image : capture.images) masks.push_back(image.mask.string());
    return masks;
  }
};

TEST_F(MasksTest, AreFoundBesideTheirPhotosUnderEitherName) {
  WritePhotos(3);
  WriteMask("masks/photo_00.png");
  WriteMask("Masks/photo_01.png.png");
  const Capture capture = RunIngest();
  EXPECT_EQ(MasksOf(capture), (std::vector<std::string>{"masks/photo_00.png", "Masks/photo_01.png.png", ""}));
  EXPECT_EQ(capture.masks, Masks::kIgnore);
  EXPECT_EQ(capture.background, Background::kNone);
  EXPECT_EQ(capture.images[0].info.channels, 4);
  EXPECT_EQ(capture.images[2].info.channels, 3);
  EXPECT_EQ(manifest_.facts["n_masks"], 2);
  EXPECT_EQ(manifest_.facts["masks"], "ignore");
}

TEST_F(MasksTest, AreFoundInAFolderBesideThatOfThePhotos) {
  WritePhotos(2, "images/left/photo_");
  WritePhotos(2, "images/right/photo_", {.width = 64});
  for (const char* name : {"photo_00.png", "photo_01.png"}) {
    WriteMask(std::string("masks/left/") + name);
    WriteMask(std::string("masks/right/") + name, 64);
  }
  EXPECT_EQ(MasksOf(RunIngest()), (std::vector<std::string>{"masks/left/photo_00.png", "masks/left/photo_01.png",
                                                            "masks/right/photo_00.png", "masks/right/photo_01.png"}));
}

TEST_F(MasksTest, OneForTwoPhotosIsAnError) {
  WritePhotos(2, "left/photo_");
  WritePhotos(2, "right/photo_");
  WriteMask("masks/photo_00.png");
  EXPECT_THAT(ErrorOf(),
              HasSubstr("masks/photo_00.png: may be the mask of left/photo_00.png and of right/photo_00.png"));
}

TEST_F(MasksTest, OfNoPhotoAreNamed) {
  WritePhotos(3);
  WriteMask("masks/photo_07.png");
  const Capture capture = RunIngest();
  ASSERT_EQ(capture.rejected.size(), 1u);
  EXPECT_EQ(capture.rejected[0].name, "masks/photo_07.png");
  EXPECT_EQ(capture.rejected[0].reason, "is a mask of no photo");
}

TEST_F(MasksTest, AFolderOfPhotosCalledMasksHoldsPhotos) {
  WritePhotos(3, "masks/photo_");
  EXPECT_EQ(MasksOf(RunIngest()), (std::vector<std::string>{"", "", ""}));
}

TEST_F(MasksTest, TheOneOfThePhotosFullNameComesFirst) {
  WritePhotos(3);
  WriteMask("masks/photo_00.png.png");
  WriteMask("masks/photo_00.png", 48, 32, 5);
  WriteMask("mask/photo_00.png", 48, 32, 6);
  const Capture capture = RunIngest();
  EXPECT_EQ(capture.images[0].mask, "masks/photo_00.png.png");
  EXPECT_EQ(capture.rejected.size(), 2u) << "the others are named";
}

TEST_F(MasksTest, OneMaskOfAllFramesIsGivenInTransformsJson) {
  WritePhotos(4);
  WriteMask("masks/rig.png");
  Json frames = RingFrames(4, "photo_");
  for (Json& frame : frames) frame["mask_path"] = "masks/rig.png";
  Write("transforms.json", Json{{"camera_angle_x", 0.8}, {"frames", frames}}.dump());
  EXPECT_EQ(MasksOf(RunIngest()), std::vector<std::string>(4, "masks/rig.png"));
}

TEST_F(MasksTest, TransformsJsonNamesThem) {
  WritePhotos(4);
  WriteMask("m/first.png");
  Json frames = RingFrames(4, "photo_");
  frames[0]["mask_path"] = "m/first.png";
  frames[1]["mask_path"] = "m/gone.png";
  Write("transforms.json", Json{{"camera_angle_x", 0.8}, {"frames", frames}}.dump());
  const Capture capture = RunIngest();
  EXPECT_EQ(MasksOf(capture), (std::vector<std::string>{"m/first.png", "", "", ""}));
  ASSERT_EQ(capture.rejected.size(), 1u);
  EXPECT_THAT(capture.rejected[0].reason, HasSubstr("as a mask but does not exist"));
}

TEST_F(MasksTest, ThatCannotBeOnesRejectTheirPhotosByName) {
  WritePhotos(6);
  WriteMask("masks/photo_00.png", 32, 32, 16);
  WriteMask("masks/photo_01.png", 48, 32, 48);
  Write("masks/photo_02.png", "no image");
  WriteMask("masks/photo_03.png", 48, 32, 0);  // counts everything
  const Capture capture = RunIngest();
  ASSERT_EQ(capture.rejected.size(), 3u);
  EXPECT_EQ(capture.rejected[0].name, "photo_00.png");
  EXPECT_THAT(capture.rejected[0].reason, HasSubstr("32×32 px, but the photo it is the mask of is 48×32 px"));
  EXPECT_THAT(capture.rejected[1].reason, HasSubstr("counts no pixel of its photo"));
  EXPECT_EQ(capture.rejected[2].name, "photo_02.png");
  ASSERT_EQ(capture.images.size(), 3u);
  EXPECT_EQ(capture.images[0].info.channels, 3);
}

TEST_F(MasksTest, MeanTheBackgroundOrNothingWhereThatIsAskedFor) {
  WritePhotos(3);
  WriteMask("masks/photo_00.png");
  const Capture background = RunIngest({.masks = Masks::kBackground});
  EXPECT_EQ(background.masks, Masks::kBackground);
  EXPECT_EQ(background.background, Background::kWhite);
  const Capture off = RunIngest({.masks = {}, .without_masks = true});
  EXPECT_EQ(MasksOf(off), (std::vector<std::string>{"", "", ""}));
  EXPECT_EQ(off.images[0].info.channels, 3);
}

TEST_F(MasksTest, OfTheStoredRasterTurnWithThePhoto) {
  for (uint32_t i = 0; i < 3; ++i) {
    WritePhoto(root_ / ("photo_0" + std::to_string(i) + ".jpg"),
               {.seed = i, .metadata = [](OIIO::ImageSpec& spec) { spec.attribute("Orientation", 6); }}, "jpeg");
  }
  WriteMask("masks/photo_00.png");             // 48×32, as stored
  WriteMask("masks/photo_01.png", 32, 48, 8);  // as shown
  const Capture capture = RunIngest();
  ASSERT_EQ(capture.images.size(), 3u);
  const Image stored = ReadCapturedPhoto(capture, capture.images[0]),
              shown = ReadCapturedPhoto(capture, capture.images[1]);
  ASSERT_EQ(stored.width, 32);
  // Orientation 6: the stored left is shown at the top.
  EXPECT_EQ(stored.pixels[3], 0);
  EXPECT_EQ(stored.pixels[4 * (47 * 32) + 3], 255);
  EXPECT_EQ(shown.pixels[3], 0);
  EXPECT_EQ(shown.pixels[4 * 8 + 3], 255);
}

TEST_F(MasksTest, ColoursStayWhereTheyDoNotCountAndNoFeaturesAreFoundThere) {
  WritePhotos(3);
  WriteMask("masks/photo_00.png", 48, 32, 13);
  const Capture capture = RunIngest();
  const CaptureImage& photo = capture.images[0];
  const Lens lens({0, CameraModel::kSimplePinhole, 48, 32, {48., 24., 16.}});
  const Image half = ResampledPhoto(capture, photo, lens, ScaledTarget(lens, 24));
  const Image whole = Resample(ReadImageOriented(root_ / photo.path), lens, ScaledTarget(lens, 24));
  ASSERT_EQ(half.channels, 4);
  for (size_t i = 0; i < whole.pixels.size(); ++i) ASSERT_EQ(half.pixels[i / 3 * 4 + i % 3], whole.pixels[i]);
  EXPECT_EQ(half.pixels[4 * 5 + 3], 0);
  EXPECT_NEAR(half.pixels[4 * 6 + 3], 127.5, 1);  // half of its photo pixels count
  EXPECT_EQ(half.pixels[4 * 7 + 3], 255);

  const fs::path working = work_.path() / "working";
  WriteWorkingPhotos(capture, 24, 1, working);
  const Image copy = ReadImageOriented(working / WorkingPhotoName(photo));
  EXPECT_EQ(copy.pixels, whole.pixels);
  const Image mask = ReadImageOriented(MasksOfWorkingPhotos(working) / (WorkingPhotoName(photo) + ".png"));
  EXPECT_EQ(mask.pixels[3 * 5], 0);
  EXPECT_EQ(mask.pixels[3 * 7], 255);
  EXPECT_FALSE(fs::exists(MasksOfWorkingPhotos(working) / (WorkingPhotoName(capture.images[1]) + ".png")));
}

TEST_F(MasksTest, OfTurnedPhotosLieAsTheirSensorHadThemForFeatures) {
  for (uint32_t i = 0; i < 3; ++i) {
    WritePhoto(root_ / ("photo_0" + std::to_string(i) + ".jpg"),
               {.seed = i, .metadata = [](OIIO::ImageSpec& spec) { spec.attribute("Orientation", 6); }}, "jpeg");
  }
  WriteMask("masks/photo_00.png", 48, 32, 20);  // as stored
  const Capture capture = RunIngest();
  const fs::path working = work_.path() / "working";
  WriteWorkingPhotos(capture, 48, 1, working);
  const std::string name = WorkingPhotoName(capture.images[0]);
  const Image mask = ReadImageOriented(MasksOfWorkingPhotos(working) / (name + ".png"));
  ASSERT_EQ(std::pair(mask.width, mask.height), std::pair(48, 32));
  for (const int row : {1, 30}) {
    EXPECT_EQ(mask.pixels[size_t(3 * (48 * row + 18))], 0) << row;
    EXPECT_EQ(mask.pixels[size_t(3 * (48 * row + 22))], 255) << row;
  }
  const Image copy = ReadImageOriented(working / name);
  EXPECT_EQ(std::pair(copy.width, copy.height), std::pair(48, 32));
}

TEST_F(MasksTest, ThatChangedSinceAreNamed) {
  WritePhotos(3);
  WriteMask("masks/photo_00.png");
  const Capture capture = RunIngest();
  WriteMask("masks/photo_00.png", 48, 32, 5);
  try {
    ReadCapturedPhoto(capture, capture.images[0]);
    FAIL();
  } catch (const Error& error) {
    EXPECT_THAT(error.what(), HasSubstr("masks/photo_00.png has changed since it was ingested"));
  }
}

}  // namespace
}  // namespace nrff
