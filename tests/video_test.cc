// Frames of videos: which are chosen, and what becomes of a capture that holds videos.
#include "sfm/video.h"

#include <cmath>
#include <cstdlib>
#include <random>

#include "sfm/frame_choice.h"
#include "sfm/photo_work.h"
#include "sfm/video_measures.h"
#include "sfm/video_stream.h"
#include "tests/ingest_fixture.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;
using ::testing::AllOf;
using ::testing::HasSubstr;
using ::testing::Not;

std::vector<int> Kept(const std::vector<FrameVerdict>& verdicts) {
  std::vector<int> kept;
  for (size_t i = 0; i < verdicts.size(); ++i) {
    if (verdicts[i] == FrameVerdict::kKept) kept.push_back(int(i));
  }
  return kept;
}

TEST(ChooseFrames, AreAsFarApartAsThePictureMovesNotAsTimePasses) {
  std::vector<FrameMeasure> frames(300, {1, 0.002});
  for (size_t i = 100; i < 200; ++i) frames[i].motion = 0.02;  // ten times as fast
  const std::vector<int> kept = Kept(ChooseFrames(frames, 24));
  EXPECT_EQ(kept.size(), 24u);
  int n_fast = 0;
  for (const int frame : kept) n_fast += frame >= 100 && frame < 200;
  EXPECT_EQ(n_fast, 20);
}

TEST(ChooseFrames, TheSharpestOfItsStretchIsKeptAndABlurredOneSaysSo) {
  std::vector<FrameMeasure> frames(100, {1, 0.01});
  for (size_t i = 0; i < 100; ++i) {
    if (i % 10 != 3) frames[i].sharpness = i % 2 == 0 ? 0.4 : 0.8;
  }
  const std::vector<FrameVerdict> verdicts = ChooseFrames(frames, 10);
  EXPECT_EQ(Kept(verdicts), (std::vector<int>{3, 13, 23, 33, 43, 53, 63, 73, 83, 93}));
  EXPECT_EQ(verdicts[4], FrameVerdict::kBlurred);
  EXPECT_EQ(verdicts[5], FrameVerdict::kNear);
}

TEST(ChooseFrames, WhatStandsStillIsKeptOnce) {
  std::vector<FrameMeasure> frames(100, {1, 0});
  for (size_t i = 0; i < 40; ++i) frames[i].motion = 0.02;
  frames[70].sharpness = 1.2;
  const std::vector<FrameVerdict> verdicts = ChooseFrames(frames, 30);
  const std::vector<int> kept = Kept(verdicts);
  EXPECT_EQ(kept.back(), 70) << "the sharpest of those that show the same";
  EXPECT_LT(kept[kept.size() - 2], 39);
  EXPECT_EQ(verdicts[60], FrameVerdict::kRepeated);
  EXPECT_EQ(Kept(ChooseFrames(std::vector<FrameMeasure>(50, {1, 0}), 0)).size(), 1u);
}

TEST(ChooseFrames, AMotionByLeapsHasAsManyAsAreWanted) {
  std::vector<FrameMeasure> frames;
  for (int i = 0; i < 40; ++i) {  // still between leaps, every fourth of them four times as far
    for (int k = 0; k < 4; ++k) frames.push_back({k == 2 ? 1. : 0.9, k > 0 ? 0 : i % 4 == 0 ? 0.4 : 0.1});
  }
  const std::vector<int> kept = Kept(ChooseFrames(frames, 40));
  ASSERT_EQ(kept.size(), 40u);
  for (int i = 0; i < 40; ++i) EXPECT_EQ(kept[size_t(i)] / 4, i);
}

TEST(ChooseFrames, AStretchThatIsBlurredAltogetherIsLeftOut) {
  std::vector<FrameMeasure> frames(100, {1, 0.01});
  for (size_t i = 40; i < 60; ++i) frames[i].sharpness = 0.2;
  const std::vector<FrameVerdict> verdicts = ChooseFrames(frames, 20);
  for (size_t i = 40; i < 60; ++i) EXPECT_EQ(verdicts[i], FrameVerdict::kBlurred) << i;
  EXPECT_EQ(Kept(verdicts).size(), 16u);
}

TEST(ChooseFrames, OddVideosAreNoTrouble) {
  EXPECT_TRUE(ChooseFrames({}, 0).empty());
  EXPECT_EQ(Kept(ChooseFrames({{0, 0}}, 0)), (std::vector<int>{0}));
  EXPECT_EQ(Kept(ChooseFrames(std::vector<FrameMeasure>(5, {1, 0.1}), 200)).size(), 5u);
  EXPECT_EQ(Kept(ChooseFrames(std::vector<FrameMeasure>(2000, {1, 0.1}), 0)).size(), size_t(kMostFrames));
}

// A window on a wall of soft random blobs.
GreyPicture Wall(double x, double y, int width = 320, int height = 180, int blur = 1) {
  GreyPicture picture{width, height, std::vector<uint8_t>(size_t(width) * size_t(height))};
  for (int v = 0; v < height; ++v) {
    for (int u = 0; u < width; ++u) {
      double sum = 0;
      for (int b = 0; b < blur; ++b) {  // along the motion
        const double s = (x + u + 2 * b) * 0.15, t = (y + v) * 0.15;
        sum += std::sin(3 * s + 2 * std::sin(1.3 * t)) + std::sin(2.1 * t + std::cos(2.7 * s)) +
               std::sin(1.7 * s * 1.37 - t);
      }
      picture.pixels[size_t(v) * size_t(width) + size_t(u)] = uint8_t(128 + 40 * sum / blur);
    }
  }
  return picture;
}

TEST(VideoMeasures, MotionIsThatOfThePicture) {
  for (const auto& [dx, dy] : {std::pair(0., 0.), {3., 0.}, {0., 5.}, {4., -3.}}) {
    EXPECT_NEAR(MeasureMotion(Wall(0, 0), Wall(dx, dy)), std::hypot(dx, dy) / 320, 0.002) << dx << " " << dy;
  }
  const GreyPicture grey{320, 180, std::vector<uint8_t>(320 * 180, 90)};
  EXPECT_EQ(MeasureMotion(grey, grey), 0);
}

TEST(VideoMeasures, SharpnessFallsWithBlurAndNotWithContrast) {
  const GreyPicture sharp = Wall(0, 0), blurred = Wall(0, 0, 320, 180, 6);
  GreyPicture faint = sharp;
  for (uint8_t& value : faint.pixels) value = uint8_t(64 + value / 2);
  EXPECT_LT(MeasureSharpness(blurred), 0.5 * MeasureSharpness(sharp));
  EXPECT_NEAR(MeasureSharpness(faint), MeasureSharpness(sharp), 0.1 * MeasureSharpness(sharp));
  EXPECT_EQ(MeasureSharpness({4, 4, std::vector<uint8_t>(16, 7)}), 0);
}

class VideoTest : public IngestTest {
 protected:
  void SetUp() override {
    if (std::system("command -v ffmpeg >/dev/null") != 0) GTEST_SKIP() << "FFmpeg is not installed";
    fs::create_directories(root_);
  }

  // 12 frames a second; picture i is Wall at x = positions[i], blurred where blur says so.
  void WriteVideo(const std::string& name, const std::vector<double>& positions, const std::vector<int>& blur = {},
                  const std::string& options = "") {
    const fs::path raw = work_.path() / "raw.grey";
    std::ofstream file(raw, std::ios::binary);
    for (size_t i = 0; i < positions.size(); ++i) {
      const GreyPicture picture = Wall(positions[i], 0.3 * positions[i], 320, 180, blur.empty() ? 1 : blur[i]);
      file.write(reinterpret_cast<const char*>(picture.pixels.data()), std::streamsize(picture.pixels.size()));
    }
    file.close();
    const std::string command = "ffmpeg -nostdin -v error -y -f rawvideo -pix_fmt gray -s 320x180 -r 12 -i '" +
                                raw.string() + "' -c:v mpeg4 -q:v 2 " + options + " '" + (root_ / name).string() + "'";
    ASSERT_EQ(std::system(command.c_str()), 0) << command;
  }

  static std::vector<double> Steadily(int n, double step = 6) {
    std::vector<double> positions(static_cast<size_t>(n));
    for (int i = 0; i < n; ++i) positions[size_t(i)] = step * i;
    return positions;
  }
};

TEST_F(VideoTest, FramesBecomePhotosOfOneCameraInTheirOrder) {
  WriteVideo("a.mp4", Steadily(60));
  fs::rename(root_ / "a.mp4", root_ / "a clip's\n\xff.mp4");
  const Capture capture = RunIngest({.masks = {}, .without_masks = false, .frames = 10, .n_threads = 1});
  ASSERT_EQ(capture.images.size(), 10u);
  EXPECT_TRUE(capture.ordered);
  EXPECT_EQ(manifest_.facts["n_cameras"], 1);
  EXPECT_EQ(manifest_.facts["n_videos"], 1);
  EXPECT_EQ(manifest_.facts["n_frames"], 60);
  EXPECT_EQ(manifest_.facts["n_frames_kept"], 10);
  EXPECT_EQ(capture.images[0].split, Split::kTest);
  EXPECT_EQ(capture.images[0].path.parent_path(), "frames/a_clip_s__");
  const Image first = ReadCapturedPhoto(capture, capture.images[0]);
  EXPECT_EQ(first.width, 320);
  const Json videos = ReadJson(work_.path() / "ingest" / kVideosFile);
  EXPECT_EQ(videos["videos"][0]["verdict"].size(), 60u);
  for (const Json& thumbnail : videos["videos"][0]["thumbnails"]) {
    EXPECT_TRUE(fs::exists(work_.path() / "ingest" / thumbnail["file"].get<std::string>()));
  }
}

TEST_F(VideoTest, AVideoAloneIsACaptureNamedAfterIt) {
  WriteVideo("clip.MP4", Steadily(60));
  root_ /= "clip.MP4";
  const Json probe = ProbeCapture(root_);
  EXPECT_EQ(probe["n_videos"], 1);
  EXPECT_EQ(probe["name"], "clip");
  const Capture capture = RunIngest();
  EXPECT_EQ(capture.name, "clip");
  EXPECT_EQ(capture.images.size(), size_t(kFewestFrames));
}

TEST_F(VideoTest, BlurredAndRepeatedFramesAreNotTaken) {
  std::vector<double> positions;
  std::vector<int> blur;
  for (int i = 0; i < 40; ++i) {
    for (const int b : {1, 6, 1}) {  // each place sharp, blurred, and sharp again
      positions.push_back(8 * i);
      blur.push_back(b);
    }
  }
  WriteVideo("clip.mp4", positions, blur);
  const Capture capture = RunIngest({.masks = {}, .without_masks = false, .frames = 20, .n_threads = 1});
  EXPECT_EQ(capture.images.size(), 20u);
  for (const CaptureImage& image : capture.images) {
    const std::string name = image.path.stem();
    EXPECT_NE(std::stoi(name.substr(name.rfind('_') + 1)) % 3, 1) << name << " is blurred";
  }
  EXPECT_TRUE(capture.duplicates.empty());
}

TEST_F(VideoTest, RotationIsHonoured) {
  WriteVideo("plain.mp4", Steadily(30));
  const std::string turn = "ffmpeg -nostdin -v error -y -i '" + (root_ / "plain.mp4").string() +
                           "' -c copy -metadata:s:v:0 rotate=90 '" + (root_ / "turned.mp4").string() + "'";
  ASSERT_EQ(std::system(turn.c_str()), 0);
  fs::remove(root_ / "plain.mp4");
  const Capture capture = RunIngest();
  EXPECT_EQ(capture.images.front().info.width, 180);
  EXPECT_EQ(capture.images.front().info.height, 320);
}

TEST_F(VideoTest, SeveralVideosAndPhotosAreOneCapture) {
  WriteVideo("a.mp4", Steadily(30));
  fs::create_directories(root_ / "more");
  WriteVideo("more/a.avi", Steadily(30, -6));
  WritePhotos(3);
  Write("photo_00.mov", "a live photo's video");
  const Capture capture = RunIngest({.masks = {}, .without_masks = false, .frames = 8, .n_threads = 2});
  EXPECT_EQ(capture.images.size(), 8u + 8 + 3);
  EXPECT_EQ(manifest_.facts["n_cameras"], 3);
  ASSERT_EQ(capture.rejected.size(), 1u);
  EXPECT_THAT(capture.rejected[0].reason, HasSubstr("live photo"));
  EXPECT_FALSE(capture.ordered);
  EXPECT_EQ(capture.images[0].path.parent_path(), "frames/a-2");  // the order of bytes
  EXPECT_EQ(capture.images[8].path.parent_path(), "frames/a");
}

TEST_F(VideoTest, WhatCannotBeDecodedIsNamedAndTheRestIsUsed) {
  Write("broken.mp4", "");
  EXPECT_THAT(ErrorOf(), HasSubstr("(the file is empty)"));
  fs::remove(root_ / "broken.mp4");
  WriteVideo("broken.mp4", Steadily(60));
  fs::resize_file(root_ / "broken.mp4", fs::file_size(root_ / "broken.mp4") / 2);
  EXPECT_THAT(ErrorOf(), HasSubstr("(its index is missing: the recording or a copy was cut short)"));
  Write("broken.mp4", "this is no video");
  EXPECT_THAT(ErrorOf(), HasSubstr("broken.mp4 holds no video that can be decoded (Invalid data found"));
  WritePhotos(3);
  const Capture capture = RunIngest();
  EXPECT_EQ(capture.images.size(), 3u);
  ASSERT_EQ(capture.rejected.size(), 1u);
  EXPECT_EQ(capture.rejected[0].name, "broken.mp4");

  WriteVideo("broken.mp4", Steadily(60), {}, "-f mpegts");  // can be cut anywhere
  fs::resize_file(root_ / "broken.mp4", fs::file_size(root_ / "broken.mp4") * 2 / 3);
  const Capture cut = RunIngest({.masks = {}, .without_masks = false, .frames = 8, .n_threads = 1});
  EXPECT_EQ(cut.images.size(), 3u + 8);
}

// HD video has another matrix than JPEG files are read with, whether it says so or not.
TEST_F(VideoTest, ColoursAreThoseOfTheVideo) {
  const fs::path video = root_ / "red.mp4";
  for (const std::string kind : {"s=320x180 -colorspace bt709", "s=1280x720"}) {
    const std::string size = kind.substr(0, kind.find(' ')), tag = kind.substr(size.size());
    const std::string command = "ffmpeg -nostdin -v error -y -f lavfi -i color=c=0xC02040:" + size +
                                ":d=0.2 -vf scale=out_color_matrix=bt709:out_range=tv,format=yuv420p" + tag +
                                " -color_range tv -c:v libx264 -crf 5 '" + video.string() + "'";
    ASSERT_EQ(std::system(command.c_str()), 0);
    WriteFrames(video, ProbeVideo(video), {{{0}, {root_ / "f%d" / "frame.jpg"}, 0}}, root_);
    const Image frame = ReadImageOriented(root_ / "f%d" / "frame.jpg");
    EXPECT_NEAR(frame.pixels[0], 0xC0, 6) << kind;
    EXPECT_NEAR(frame.pixels[1], 0x20, 6) << kind;
    EXPECT_NEAR(frame.pixels[2], 0x40, 6) << kind;
  }
}

TEST_F(VideoTest, AnotherVideoOfThatNameMakesIngestRunAgain) {
  WriteVideo("clip.mp4", Steadily(20));
  const std::string before = HashTree(root_ / "clip.mp4");
  WriteVideo("clip.mp4", Steadily(21));
  EXPECT_NE(HashTree(root_ / "clip.mp4"), before);
}

}  // namespace
}  // namespace nrff
