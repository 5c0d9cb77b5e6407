// What leaves the renderer: PNG files and camera paths.

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <png.h>

#include <cmath>
#include <cstdio>
#include <fstream>
#include <numbers>
#include <random>

#include "pipeline/error.h"
#include "render/camera_path.h"
#include "render/png.h"
#include "tests/temporary_directory.h"

namespace nrff {
namespace {

using testing::HasSubstr;

struct DecodedPng {
  int width = 0, height = 0, channels = 0, bit_depth = 0;
  std::vector<uint16_t> values;
};

// Every value as it is stored, without gamma or conversion.
DecodedPng DecodePng(const std::filesystem::path& path) {
  DecodedPng out;
  std::FILE* file = std::fopen(path.c_str(), "rb");
  if (file == nullptr) return out;
  png_structp png = png_create_read_struct(PNG_LIBPNG_VER_STRING, nullptr, nullptr, nullptr);
  png_infop info = png_create_info_struct(png);
  png_init_io(png, file);
  png_read_png(png, info, PNG_TRANSFORM_IDENTITY, nullptr);
  out.width = static_cast<int>(png_get_image_width(png, info));
  out.height = static_cast<int>(png_get_image_height(png, info));
  out.channels = png_get_channels(png, info);
  out.bit_depth = png_get_bit_depth(png, info);
  png_bytepp rows = png_get_rows(png, info);
  for (int y = 0; y < out.height; ++y) {
    for (int i = 0; i < out.width * out.channels; ++i) {
      out.values.push_back(out.bit_depth == 8 ? rows[y][i] : rows[y][2 * i] * 256 + rows[y][2 * i + 1]);
    }
  }
  png_destroy_read_struct(&png, &info, nullptr);
  std::fclose(file);
  return out;
}

template <typename Sample>
void ExpectRoundTrip(int width, int height, int channels) {
  const TemporaryDirectory directory;
  std::mt19937 random(channels);
  std::vector<Sample> data(static_cast<size_t>(width) * height * channels);
  for (Sample& v : data) v = static_cast<Sample>(random());
  WritePng(directory.path() / "image.png", width, height, channels, data);
  const DecodedPng decoded = DecodePng(directory.path() / "image.png");
  EXPECT_EQ(decoded.width, width);
  EXPECT_EQ(decoded.height, height);
  EXPECT_EQ(decoded.channels, channels);
  EXPECT_EQ(decoded.bit_depth, 8 * static_cast<int>(sizeof(Sample)));
  EXPECT_EQ(decoded.values, std::vector<uint16_t>(data.begin(), data.end()));
}

TEST(PngTest, EveryValueComesBackInEveryFormat) {
  for (const int channels : {1, 3, 4}) {
    ExpectRoundTrip<uint8_t>(37, 23, channels);
    ExpectRoundTrip<uint16_t>(37, 23, channels);
    ExpectRoundTrip<uint8_t>(1, 1, channels);
  }
}

TEST(PngTest, SizesThatDoNotFitAreRefusedAndAFailedWriteNamesTheFile) {
  EXPECT_THROW(WritePng("never.png", 2, 2, 3, std::vector<uint8_t>(11)), Error);
  EXPECT_THROW(WritePng("never.png", 2, 2, 2, std::vector<uint8_t>(8)), Error);
  try {
    WritePng("/nonexistent/never.png", 1, 1, 1, std::vector<uint8_t>(1));
    FAIL();
  } catch (const Error& error) {
    EXPECT_EQ(error.code(), ExitCode::kResource);
    EXPECT_THAT(error.what(), HasSubstr("never.png"));
  }
}

Vec3 Column(const Mat4& m, int c) { return {m[c], m[4 + c], m[8 + c]}; }
double Dot(const Vec3& a, const Vec3& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// Cameras on a circle of radius 3 at height 1.5 around (0.2, −0.1, 0), looking there; two strays far away.
Scene RingScene() {
  Scene scene;
  scene.name = "ring";
  scene.far = 8;
  const Vec3 target{0.2, -0.1, 0};
  for (int i = 0; i < 12; ++i) {
    const double angle = 2 * std::numbers::pi * i / 12, reach = i % 6 == 5 ? 30 : 3;
    const Vec3 position{target[0] + reach * std::cos(angle), target[1] + reach * std::sin(angle), reach / 2};
    Vec3 z{target[0] - position[0], target[1] - position[1], target[2] - position[2]};
    const double norm = std::sqrt(Dot(z, z));
    for (double& v : z) v /= norm;
    const double across = std::hypot(z[0], z[1]);
    const Vec3 x{z[1] / across, -z[0] / across, 0};
    const Vec3 y{z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0]};
    View view{.id = "0", .name = "0", .width = 200, .height = 100, .fx = 150, .fy = 150, .cx = 100, .cy = 50};
    view.scene_from_camera = {x[0], y[0], z[0], position[0], x[1], y[1], z[1], position[1],
                              x[2], y[2], z[2], position[2], 0,    0,    0,    1};
    scene.views.push_back(view);
  }
  scene.scene_from_world = {0, -2, 0, 1, 2, 0, 0, 0, 0, 0, 2, -1, 0, 0, 0, 1};  // scale 2, a quarter turn about z
  return scene;
}

void ExpectRigidUprightAndLookingAt(const View& view, const Vec3& target) {
  const Mat4& m = view.scene_from_camera;
  for (int a = 0; a < 3; ++a) {
    for (int b = 0; b < 3; ++b) EXPECT_NEAR(Dot(Column(m, a), Column(m, b)), a == b ? 1 : 0, 1e-12);
  }
  const Vec3 x = Column(m, 0), y = Column(m, 1), z = Column(m, 2), o = Column(m, 3);
  EXPECT_NEAR(x[1] * y[2] - x[2] * y[1], z[0], 1e-12);  // right-handed
  EXPECT_NEAR(x[2], 0, 1e-12);                          // horizon level
  EXPECT_LT(y[2], 0);                                   // image's down is scene's down
  const Vec3 line{target[0] - o[0], target[1] - o[1], target[2] - o[2]};
  EXPECT_NEAR(Dot(line, z), std::sqrt(Dot(line, line)), 1e-9);
}

TEST(CameraPathTest, FocusIsWhereTheCamerasLook) {
  const Vec3 focus = FocusPoint(RingScene());
  EXPECT_NEAR(focus[0], 0.2, 1e-9);
  EXPECT_NEAR(focus[1], -0.1, 1e-9);
  EXPECT_NEAR(focus[2], 0, 1e-9);
  Scene parallel = RingScene();
  for (View& view : parallel.views) view.scene_from_camera = {1, 0, 0, view.cx, 0, 1, 0, 0, 0, 0, 1, -3, 0, 0, 0, 1};
  EXPECT_THAT(FocusPoint(parallel), testing::ElementsAre(0, 0, 0));
}

TEST(CameraPathTest, OrbitIsALevelCircleAtTheMedianDistanceAndHeightWhateverStraysDo) {
  const Scene scene = RingScene();
  const auto views = OrbitPath(scene, {.n_frames = 17, .width = 64, .height = 50});
  ASSERT_EQ(views.size(), 17U);
  EXPECT_EQ(views[16].id, "000016");
  for (const View& view : views) {
    const Vec3 o = Column(view.scene_from_camera, 3);
    EXPECT_NEAR(std::hypot(o[0] - 0.2, o[1] + 0.1), 3, 1e-9);
    EXPECT_NEAR(o[2], 1.5, 1e-9);
    ExpectRigidUprightAndLookingAt(view, FocusPoint(scene));
    EXPECT_EQ(view.width, 64);
    EXPECT_EQ(view.height, 50);
    EXPECT_DOUBLE_EQ(view.fy, 75);  // half the height, the same field of view
    EXPECT_DOUBLE_EQ(view.cx, 32);
    EXPECT_DOUBLE_EQ(view.cy, 25);
  }
}

TEST(CameraPathTest, SpiralStaysAmongTheCamerasAndLooksAtTheFocus) {
  Scene scene = RingScene();
  scene.views.resize(4);  // one side only
  const auto views = SpiralPath(scene, {.n_frames = 30});
  ASSERT_EQ(views.size(), 30U);
  for (const View& view : views) {
    ExpectRigidUprightAndLookingAt(view, FocusPoint(scene));
    const Vec3 o = Column(view.scene_from_camera, 3);
    EXPECT_LT(std::sqrt(Dot(o, o)), 6);
    EXPECT_EQ(view.width, 200);
  }
  EXPECT_NE(views[0].scene_from_camera, views[7].scene_from_camera);
}

class PathFileTest : public testing::Test {
 protected:
  std::vector<View> Read(const std::string& text, PathOptions options = {}) {
    std::ofstream(file()) << text;
    return ReadPath(file(), RingScene(), options);
  }
  std::string ErrorOf(const std::string& text) {
    try {
      Read(text);
    } catch (const Error& error) {
      EXPECT_EQ(error.code(), ExitCode::kInput) << error.what();
      return error.what();
    }
    return "no error";
  }
  std::filesystem::path file() const { return directory_.path() / "path.json"; }

 private:
  TemporaryDirectory directory_;
};

TEST_F(PathFileTest, ScenePosesAreTakenAsTheyAre) {
  const auto views = Read(R"([{"scene_from_camera": [1,0,0,5, 0,1,0,6, 0,0,1,7, 0,0,0,1]},
                              {"scene_from_camera": [[0,-1,0,1],[1,0,0,2],[0,0,1,3],[0,0,0,1]]}])");
  ASSERT_EQ(views.size(), 2U);
  EXPECT_THAT(Column(views[0].scene_from_camera, 3), testing::ElementsAre(5, 6, 7));
  EXPECT_THAT(Column(views[1].scene_from_camera, 0), testing::ElementsAre(0, 1, 0));
  EXPECT_EQ(views[0].fx, 150);
}

TEST_F(PathFileTest, NerfstudioPathsComeFromTheCapturesWorldInOpenGlAxes) {
  const auto views = Read(R"({"camera_path": [{"camera_to_world": [1,0,0,1, 0,1,0,0, 0,0,1,3, 0,0,0,1], "fov": 90}],
                              "render_width": 320, "render_height": 240, "fps": 24})");
  ASSERT_EQ(views.size(), 1U);
  const View& view = views[0];
  EXPECT_EQ(view.width, 320);
  EXPECT_DOUBLE_EQ(view.fy, 120);  // tan 45° = 120 / fy
  // scene = 2·turn·world + t: position (1, 0, 3) → (1, 2, 5); OpenGL looks along −z, which the turn leaves.
  EXPECT_THAT(Column(view.scene_from_camera, 3), testing::ElementsAre(1, 2, 5));
  EXPECT_THAT(Column(view.scene_from_camera, 2), testing::ElementsAre(0, 0, -1));
  EXPECT_THAT(Column(view.scene_from_camera, 0), testing::ElementsAre(0, 1, 0));
}

TEST_F(PathFileTest, WrongFilesAreInputErrorsThatNameTheFrame) {
  EXPECT_THAT(ErrorOf("not json"), HasSubstr("path.json"));
  EXPECT_THAT(ErrorOf("[]"), HasSubstr("no list of frames"));
  EXPECT_THAT(ErrorOf(R"({"frames": 3})"), HasSubstr("no list of frames"));
  EXPECT_THAT(ErrorOf(R"([{"pose": 1}])"), HasSubstr("frame 0"));
  EXPECT_THAT(ErrorOf(R"([{"scene_from_camera": [1,2,3]}])"), HasSubstr("3 numbers"));
  EXPECT_THAT(ErrorOf(R"([{"scene_from_camera": [1,0,0,0, 0,1,0,0, 0,0,-1,0, 0,0,0,1]}])"), HasSubstr("right-handed"));
  EXPECT_THAT(ErrorOf(R"([{"scene_from_camera": [1,0,0,"x", 0,1,0,0, 0,0,1,0, 0,0,0,1]}])"), HasSubstr("finite"));
  EXPECT_THAT(ErrorOf(R"([{"scene_from_camera": [1,0.5,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]}])"), HasSubstr("rotation"));
  EXPECT_THAT(ErrorOf(R"({"camera_path": [{"camera_to_world": [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1], "fov": 190}]})"),
              HasSubstr("fov"));
  EXPECT_THAT(ErrorOf(R"({"camera_path": [{}], "render_width": "wide"})"), HasSubstr("render_width"));
}

}  // namespace
}  // namespace nrff
