// The eval stage: scenes against renders, and folders against folders.
#include <OpenImageIO/imageio.h>
#include <gtest/gtest.h>
#include <unistd.h>

#include <cmath>
#include <filesystem>
#include <functional>

#include "eval/evaluate.h"
#include "eval/image_file.h"
#include "eval/lpips.h"
#include "eval/work_precision.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/manifest.h"
#include "pipeline/scene.h"
#include "tests/eval_fixture.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

// A pose and a render artifact with `n_test` held-out views beside one training view.
class EvaluateTest : public testing::Test {
 protected:
  void SetUp() override {
    dir_ = fs::temp_directory_path() / ("nrff_eval_" + std::to_string(getpid()) + "_" +
                                        testing::UnitTest::GetInstance()->current_test_info()->name());
    fs::remove_all(dir_);
    fs::create_directories(dir_);
  }
  void TearDown() override { fs::remove_all(dir_); }

  static uint8_t Pixel(int view, size_t i) { return uint8_t((view * 31 + i * 7) % 200); }

  // counts: of masked views, the alpha of a pixel.
  void MakeScene(int n_test, int width = 16, int height = 12, int channels = 3,
                 Background background = Background::kNone, const std::function<int(size_t)>& counts = {}) {
    Scene scene;
    scene.name = "made";
    scene.background = background;
    scene.scene_from_world = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
    std::string pixels;
    for (int v = 0; v <= n_test; ++v) {
      View view;
      view.id = "00000" + std::to_string(v);
      view.name = "photo \"" + std::to_string(v) + "\".jpg";
      view.split = v == 0 ? Split::kTrain : Split::kTest;
      view.width = width, view.height = height, view.channels = channels;
      view.masked = bool(counts);
      view.pack_offset = pixels.size();
      view.fx = view.fy = 20, view.cx = width / 2.0, view.cy = height / 2.0;
      view.scene_from_camera = scene.scene_from_world;
      for (size_t i = 0; i < view.PixelBytes(); ++i) {
        const bool is_alpha = channels == 4 && i % 4 == 3;
        pixels.push_back(char(!is_alpha ? Pixel(v, i) : counts ? counts(i / 4) : 51));
      }
      scene.views.push_back(view);
    }
    ArtifactWriter artifact("pose", dir_ / "pose", {}, {});
    WriteFileAtomically(artifact.dir() / kPackFile, pixels);
    SaveScene(scene, artifact.dir());
    artifact.facts()["split_rule"] = "every 8th by file name";
    artifact.AddOutput(kSceneFile);
    artifact.AddOutput(kPackFile);
    artifact.Commit();
    scene_ = scene;
  }

  // Renders: view v is `make(v, i)` at byte i; `n_rendered` of the held-out views.
  template <typename Make>
  void MakeRenders(int n_rendered, const Make& make, int extra_width = 0) {
    ArtifactWriter artifact("render", dir_ / "render", {}, {});
    fs::create_directories(artifact.dir() / "rgb");
    Json views = Json::array();
    for (int v = 1; v <= n_rendered; ++v) {
      const View& view = scene_.views[v];
      std::vector<uint8_t> rgb(size_t(3) * (view.width + extra_width) * view.height);
      for (size_t i = 0; i < rgb.size(); ++i) rgb[i] = make(v, i);
      const std::string path = "rgb/" + view.id + ".png";
      WriteRgbPng(artifact.dir() / path, view.width + extra_width, view.height, rgb);
      views.push_back({{"id", view.id}, {"name", view.name}, {"split", "test"}, {"rgb", path}});
    }
    WriteJson(artifact.dir() / "renders.json", {{"schema_version", 1}, {"views", views}});
    artifact.AddOutput("renders.json");
    artifact.AddOutput("rgb");
    artifact.Commit();
  }

  Json Run(const LpipsChoice& lpips = ChooseLpips(needs::kNoLpips)) {
    Evaluate(dir_ / "pose", dir_ / "render", dir_ / "eval", {}, lpips, 2);
    return ReadJson(dir_ / "eval" / "metrics.json");
  }

  fs::path dir_;
  Scene scene_;
};

TEST_F(EvaluateTest, MeansAreOfThePerImageFiguresAndNamesTheProtocol) {
  MakeScene(3);
  MakeRenders(3, [](int v, size_t i) { return uint8_t(Pixel(v, i) + v); });
  const Json result = Run();
  double psnr_mean = 0;
  for (int v = 1; v <= 3; ++v) {
    const Json& image = result["images"][v - 1];
    EXPECT_EQ(image["name"], scene_.views[v].name);
    EXPECT_NEAR(image["psnr"], 20 * std::log10(255.0 / v), 1e-9);
    EXPECT_GT(image["ssim"], 0.9);
    EXPECT_TRUE(image["lpips"].is_null());
    psnr_mean += 20 * std::log10(255.0 / v) / 3;
    EXPECT_TRUE(fs::exists(dir_ / "eval" / std::string(image["rendered"]))) << image["rendered"];
    EXPECT_EQ(image["rendered"], "../render/rgb/" + scene_.views[v].id + ".png");
    EXPECT_EQ(ReadImage(dir_ / "eval" / std::string(image["error"])).rgb.width, 16);
    const std::vector<uint8_t> truth = ToEightBits(ReadImage(dir_ / "eval" / std::string(image["truth"])).rgb);
    for (size_t i = 0; i < truth.size(); ++i) ASSERT_EQ(truth[i], Pixel(v, i));
  }
  EXPECT_NEAR(result["metrics"]["psnr"], psnr_mean, 1e-9);
  EXPECT_TRUE(result["metrics"]["lpips"].is_null());
  EXPECT_FALSE(result["metrics"]["lpips_reason"].empty());
  const Json& protocol = result["protocol"];
  for (const char* key : {"range", "quantised", "background", "ssim", "split", "resize", "images"}) {
    EXPECT_TRUE(protocol.contains(key)) << key;
  }
  EXPECT_EQ(protocol["split"], "every 8th by file name");
  EXPECT_EQ(protocol["images"].size(), 3);
  const Manifest manifest = RequireArtifact(dir_ / "eval", "eval");
  EXPECT_EQ(manifest.facts["psnr"], result["metrics"]["psnr"]);
  EXPECT_EQ(manifest.facts["n_images"], 3);
  EXPECT_EQ(manifest.inputs.size(), 2);
}

TEST_F(EvaluateTest, IdenticalImageHasNoPsnrAndIsLeftOutOfTheMean) {
  MakeScene(2);
  MakeRenders(2, [](int v, size_t i) { return uint8_t(Pixel(v, i) + (v == 2 ? 1 : 0)); });
  const Json result = Run();
  EXPECT_TRUE(result["images"][0]["psnr"].is_null());
  EXPECT_EQ(result["images"][0]["identical"], true);
  EXPECT_NEAR(result["images"][0]["ssim"], 1, 1e-12);
  EXPECT_NEAR(result["metrics"]["psnr"], 48.1308, 1e-4);
  EXPECT_EQ(result["metrics"]["n_identical"], 1);
}

TEST_F(EvaluateTest, AlphaIsCompositedOnTheScenesBackground) {
  for (const auto& [background, behind] : {std::pair{Background::kWhite, 255}, {Background::kBlack, 0}}) {
    MakeScene(1, 16, 12, 4, background);
    MakeRenders(1, [](int, size_t) { return uint8_t(0); });
    const Json result = Run();
    const std::vector<uint8_t> truth = ToEightBits(ReadImage(dir_ / "eval" / "truth" / "000001.png").rgb);
    for (size_t i = 0; i < truth.size(); ++i) {
      const double exact = Pixel(1, i / 3 * 4 + i % 3) * 0.2 + behind * 0.8;
      ASSERT_NEAR(truth[i], exact, 0.5 + 1e-9);
    }
    EXPECT_EQ(result["protocol"]["background"], behind == 255 ? "white" : "black");
  }
}

// The left half of every pixel row does not count, whatever it shows.
TEST_F(EvaluateTest, PixelsThatDoNotCountAreInTheFigureOfTheWholeImageAlone) {
  const auto left = [](size_t pixel) { return pixel % 16 < 8; };
  MakeScene(2, 16, 12, 4, Background::kNone, [&](size_t pixel) { return left(pixel) ? 0 : 255; });
  MakeRenders(2, [&](int v, size_t i) {
    const int photo = Pixel(v, i / 3 * 4 + i % 3);
    return uint8_t(left(i / 3) ? photo ^ 64 : photo ^ 1);  // 64 levels and one level off
  });
  const Json result = Run();
  EXPECT_NEAR(result["metrics"]["psnr"], 20 * std::log10(255.0), 1e-9);
  EXPECT_NEAR(result["metrics"]["variants"]["psnr_whole"], -10 * std::log10((64 * 64 + 1) / (2 * 255. * 255)), 1e-9);
  EXPECT_EQ(result["protocol"]["masked"], true);
  EXPECT_EQ(result["protocol"]["background"], "none");
  EXPECT_TRUE(result["metrics"]["variants"]["psnr_foreground"].is_null());

  MakeScene(1, 16, 12, 4, Background::kNone, [](size_t) { return 254; });
  EXPECT_EQ(Run()["metrics"]["n_images"], 0) << "nothing of it counts";
}

TEST_F(EvaluateTest, WithoutHeldOutViewFiguresAreNullWithTheReason) {
  MakeScene(0);
  MakeRenders(0, [](int, size_t) { return uint8_t(0); });
  const Json result = Run();
  EXPECT_TRUE(result["metrics"]["psnr"].is_null());
  EXPECT_TRUE(result["metrics"]["ssim"].is_null());
  EXPECT_NE(std::string(result["metrics"]["psnr_reason"]).find("held-out"), std::string::npos);
  EXPECT_EQ(result["images"], Json::array());
  EXPECT_EQ(RequireArtifact(dir_ / "eval", "eval").facts["n_images"], 0);
}

TEST_F(EvaluateTest, ViewOfOnePixelHasPsnrAndSaysWhyItHasNoSsim) {
  MakeScene(1, 1, 1);
  MakeRenders(1, [](int v, size_t i) { return uint8_t(Pixel(v, i) + 1); });
  const Json result = Run();
  EXPECT_NEAR(result["metrics"]["psnr"], 48.1308, 1e-4);
  EXPECT_TRUE(result["metrics"]["ssim"].is_null());
  EXPECT_FALSE(result["images"][0]["ssim_reason"].empty());
}

TEST_F(EvaluateTest, MissingResizedOrDamagedRenderIsAnInputErrorAndKeepsTheLastResult) {
  MakeScene(2);
  const auto good = [](int v, size_t i) { return uint8_t(Pixel(v, i) + 1); };
  MakeRenders(2, good);
  const Json before = Run();
  const auto expect_input_error = [&](const std::string& named) {
    try {
      Run();
      ADD_FAILURE() << "accepted; expected an error about " << named;
    } catch (const Error& error) {
      EXPECT_EQ(error.code(), ExitCode::kInput);
      EXPECT_NE(std::string(error.what()).find(named), std::string::npos) << error.what();
    }
    EXPECT_EQ(ReadJson(dir_ / "eval" / "metrics.json"), before);
  };
  MakeRenders(1, good);
  expect_input_error("000002");
  MakeRenders(2, good, 1);
  expect_input_error("17×12");
  MakeRenders(2, good);
  fs::resize_file(dir_ / "render/rgb/000001.png", fs::file_size(dir_ / "render/rgb/000001.png") / 2);
  const fs::path cut = dir_ / "render/rgb/000001.png";
  EXPECT_THROW(ReadImage(cut), Error);
  EXPECT_THROW(Run(), Error);
  EXPECT_EQ(ReadJson(dir_ / "eval" / "metrics.json"), before);
}

TEST_F(EvaluateTest, LpipsIsMeasuredWhereANetworkIsGivenAndSaysWith) {
  const LpipsChoice narrow{std::make_unique<LpipsNetwork>(kNarrow), needs::Lpips(kNarrow.string())};
  MakeScene(2, 40, 32);
  MakeRenders(2, [](int v, size_t i) { return uint8_t(Pixel(v, i) + 20 * (v - 1)); });
  const Json result = Run(narrow);
  EXPECT_NEAR(result["images"][0]["lpips"], 0, 1e-12);
  EXPECT_GT(result["images"][1]["lpips"], 1e-3);
  EXPECT_NEAR(result["metrics"]["lpips"], result["images"][1]["lpips"].get<double>() / 2, 1e-9);
  EXPECT_FALSE(result["metrics"].contains("lpips_reason"));
  EXPECT_EQ(result["protocol"]["lpips"]["network"], "narrow");
  EXPECT_EQ(result["protocol"]["lpips"]["hash"], narrow.network->hash());

  MakeScene(2, 40, 31);
  MakeRenders(2, [](int v, size_t i) { return uint8_t(Pixel(v, i) + v); });
  const Json small = Run(narrow);
  EXPECT_TRUE(small["images"][0]["lpips"].is_null());
  EXPECT_EQ(small["images"][0]["lpips_reason"], "the image is smaller than 32 px");
  EXPECT_TRUE(small["metrics"]["lpips"].is_null());
  EXPECT_EQ(small["metrics"]["lpips_reason"], "every image is smaller than the network can take");
}

TEST_F(EvaluateTest, PooledAndForegroundFiguresStandBesideTheMeans) {
  MakeScene(2, 16, 12, 4, Background::kWhite);  // alpha is a fifth everywhere: no foreground
  MakeRenders(2, [](int v, size_t i) { return uint8_t(std::lround(Pixel(v, i / 3 * 4 + i % 3) * 0.2 + 204) - v); });
  const Json variants = Run()["metrics"]["variants"];
  EXPECT_NEAR(variants["psnr_pooled"], 10 * std::log10(255.0 * 255 / 2.5), 1e-9);  // of errors 1 and 2: mean square 2.5
  EXPECT_NEAR(variants["psnr_quantised"], 20 * std::log10(255.0) - 5 * std::log10(4.0), 1e-9);
  EXPECT_TRUE(variants["psnr_foreground"].is_null());
}

// Two folders of images whose values are given by functions of the index.
class CompareTest : public EvaluateTest {
 protected:
  using Value = double (*)(size_t);
  void Write(const std::string& path, int channels, int bits, const Value& value) {
    fs::create_directories((dir_ / path).parent_path());
    const OIIO::ImageSpec spec(14, 12, channels, bits == 16 ? OIIO::TypeDesc::UINT16 : OIIO::TypeDesc::UINT8);
    std::vector<uint16_t> wide(size_t(14) * 12 * channels);
    for (size_t i = 0; i < wide.size(); ++i) wide[i] = uint16_t(std::lround(value(i) * (bits == 16 ? 65535 : 255)));
    const std::vector<uint8_t> narrow(wide.begin(), wide.end());
    auto file = OIIO::ImageOutput::create((dir_ / path).string());
    ASSERT_TRUE(file && file->open((dir_ / path).string(), spec));
    ASSERT_TRUE(bits == 16 ? file->write_image(OIIO::TypeDesc::UINT16, wide.data())
                           : file->write_image(OIIO::TypeDesc::UINT8, narrow.data()));
    file->close();
  }
  Json Compared(const std::string& masks = "", Background background = Background::kWhite) {
    const Folders folders{dir_ / "truth", dir_ / "rendered", masks.empty() ? fs::path() : dir_ / masks, background};
    Compare(folders, dir_ / "scores", {}, ChooseLpips(needs::kNoLpips), 2);
    return ReadJson(dir_ / "scores" / "metrics.json");
  }
};

double Grey(size_t) { return 128 / 255.0; }
double Stripes(size_t i) { return double(i % 42 < 21 ? 128 : 129) / 255; }
double FinerStripes(size_t i) { return i % 42 < 21 ? 128 / 255.0 : 128 / 255.0 + 0.001; }
double HalfAlpha(size_t i) { return i % 4 == 3 ? 127.5 / 255 : 1; }
double Opaque(size_t) { return 1; }
double RightHalf(size_t i) { return i % 14 < 7 ? 0 : 1; }

TEST_F(CompareTest, SixteenBitsAreNotRoundedAndTheRoundedFigureIsGivenToo) {
  Write("truth/a.png", 3, 16, Grey);
  Write("rendered/a.png", 3, 16, FinerStripes);
  const Json result = Compared();
  const double stored = std::lround((128 / 255.0 + 0.001) * 65535) / 65535.0 - 128 / 255.0;
  EXPECT_NEAR(result["metrics"]["psnr"], -10 * std::log10(stored * stored / 2), 1e-9);
  EXPECT_EQ(result["protocol"]["bits"], Json({{"truth", 16}, {"rendered", 16}}));
  EXPECT_EQ(result["protocol"]["quantised"], false);
  EXPECT_TRUE(result["images"][0]["psnr_quantised"].is_null());  // equal after rounding
  EXPECT_EQ(result["images"][0]["name"], "a.png");
  EXPECT_EQ(result["images"][0]["truth"], "../truth/a.png");
}

TEST_F(CompareTest, AlphaShowsTheBackgroundAndMasksLeaveOutPixels) {
  Write("truth/a.png", 4, 8, HalfAlpha);  // white at an alpha of 128
  Write("rendered/a.png", 4, 8, Opaque);
  EXPECT_EQ(Compared()["images"][0]["identical"], true);
  const Json black = Compared("", Background::kBlack);
  EXPECT_NEAR(black["metrics"]["psnr"], 20 * std::log10(255 / 127.0), 1e-9);
  EXPECT_EQ(black["protocol"]["background"], "black");
  EXPECT_NEAR(black["metrics"]["variants"]["psnr_foreground"], 20 * std::log10(255 / 127.0), 1e-9);
  Write("masks/a.png", 1, 8, RightHalf);
  const Json half = Compared("masks", Background::kBlack);  // the subject inside the mask alone
  EXPECT_NEAR(half["metrics"]["variants"]["psnr_foreground"], 20 * std::log10(255 / 127.0), 1e-9);

  Write("truth/a.png", 3, 8, Grey);
  Write("rendered/a.png", 3, 8, Stripes);  // the right half is one level off
  Write("masks/a.png", 1, 8, RightHalf);
  EXPECT_NEAR(Compared()["metrics"]["psnr"], 20 * std::log10(255.0) + 10 * std::log10(2.0), 1e-9);
  const Json masked = Compared("masks");
  EXPECT_NEAR(masked["metrics"]["psnr"], 20 * std::log10(255.0), 1e-9);
  EXPECT_EQ(masked["protocol"]["masked"], true);
}

TEST_F(CompareTest, WhatDoesNotPairIsAnInputErrorThatNamesIt) {
  const auto expect_error = [&](const std::string& named, const std::string& masks = "") {
    try {
      Compared(masks);
      ADD_FAILURE() << "accepted; expected an error about " << named;
    } catch (const Error& error) {
      EXPECT_EQ(error.code(), ExitCode::kInput);
      EXPECT_NE(std::string(error.what()).find(named), std::string::npos) << error.what();
    }
  };
  expect_error("truth is no folder");
  Write("truth/a.png", 3, 8, Grey);
  fs::create_directories(dir_ / "rendered");
  expect_error("holds no images");
  Write("rendered/b.png", 3, 8, Grey);
  expect_error("b.png has no image of that name");
  fs::rename(dir_ / "rendered/b.png", dir_ / "rendered/a.png");
  Write("masks/a.png", 1, 8, [](size_t) { return 0.0; });
  expect_error("black all over", "masks");
  WriteRgbPng(dir_ / "rendered/a.png", 3, 2, std::vector<uint8_t>(18));
  expect_error("3×2");
  Write("rendered/a.tif", 3, 8, Grey);
  expect_error("extensions alone");
}

TEST_F(EvaluateTest, WorkPrecisionHasTheScoresOwnFiguresAtFullSize) {
  MakeScene(3, 40, 24);
  MakeRenders(3, [](int v, size_t i) { return uint8_t(Pixel(v, i) + v); });
  const Json metrics = Run()["metrics"];
  const Json points = ScoringWorkPrecision(HeldOutPairs(dir_ / "pose", dir_ / "render"), nullptr);
  ASSERT_EQ(points.size(), 4);
  EXPECT_EQ(points[3]["factor"], 1);
  EXPECT_NEAR(points[3]["psnr"], metrics["psnr"], 1e-9);
  EXPECT_NEAR(points[3]["ssim"], metrics["ssim"], 1e-9);
  EXPECT_TRUE(points[3]["lpips"].is_null());
  EXPECT_EQ(points[0]["width"], 5);
  EXPECT_TRUE(points[0]["ssim"].is_null());               // smaller than the window
  EXPECT_NEAR(points[0]["psnr"], metrics["psnr"], 1e-9);  // a constant offset stays one
}

TEST_F(EvaluateTest, SameInputGivesTheSameBytes) {
  MakeScene(2);
  MakeRenders(2, [](int v, size_t i) { return uint8_t(Pixel(v, i) + 3 * v); });
  Run();
  const std::string first = RequireArtifact(dir_ / "eval", "eval").ContentHash();
  Run();
  EXPECT_EQ(RequireArtifact(dir_ / "eval", "eval").ContentHash(), first);
}

}  // namespace
}  // namespace nrff
