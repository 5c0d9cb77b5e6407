#include <gtest/gtest.h>
#include <unistd.h>

#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <limits>
#include <random>

#include "eval/error_map.h"
#include "eval/evaluate.h"
#include "eval/lpips.h"
#include "eval/metrics.h"
#include "eval/png.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/manifest.h"
#include "pipeline/scene.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

RgbImage Constant(int width, int height, double value) {
  return {width, height, std::vector<double>(size_t(3) * width * height, value)};
}

RgbImage Noise(int width, int height, unsigned seed) {
  std::mt19937 random(seed);
  RgbImage image = Constant(width, height, 0);
  for (double& value : image.rgb) value = double(random()) / std::mt19937::max();
  return image;
}

TEST(Psnr, OffsetOfOneLevelIs48Point13Decibel) {
  EXPECT_NEAR(Psnr(Constant(7, 5, 0.5), Constant(7, 5, 0.5 + 1 / 255.0)), 20 * std::log10(255.0), 1e-9);
  EXPECT_NEAR(20 * std::log10(255.0), 48.1308, 1e-4);
}

TEST(Psnr, BlackAgainstWhiteIsZeroAndIdenticalIsInfinite) {
  EXPECT_DOUBLE_EQ(Psnr(Constant(3, 3, 0), Constant(3, 3, 1)), 0);
  EXPECT_EQ(Psnr(Noise(3, 3, 1), Noise(3, 3, 1)), std::numeric_limits<double>::infinity());
}

TEST(Psnr, ErrorInOnePixelOfOneChannelIsSpreadOverAllValues) {
  RgbImage image = Constant(10, 10, 0.25);
  image.rgb[17] = 0.75;
  EXPECT_NEAR(Psnr(Constant(10, 10, 0.25), image), -10 * std::log10(0.25 / 300), 1e-12);
}

TEST(Ssim, TwoConstantsGiveTheLuminanceTerm) {
  constexpr double kC1 = 1e-4;
  for (const auto& [a, b] : {std::pair{0.25, 0.5}, {0.0, 1.0}, {0.0, 0.0}, {1.0, 254 / 255.0}}) {
    const auto ssim = Ssim(Constant(16, 13, a), Constant(16, 13, b));
    ASSERT_TRUE(ssim);
    EXPECT_NEAR(*ssim, (2 * a * b + kC1) / (a * a + b * b + kC1), 1e-11) << a << " " << b;
  }
}

TEST(Ssim, IsOneForIdenticalSymmetricAndAtMostOne) {
  const RgbImage a = Noise(20, 31, 1), b = Noise(20, 31, 2);
  EXPECT_NEAR(*Ssim(a, a), 1, 1e-12);
  EXPECT_NEAR(*Ssim(a, b), *Ssim(b, a), 1e-14);
  EXPECT_LT(*Ssim(a, b), 0.2);
}

// One window only: the definition written out, without the separation into rows and columns.
TEST(Ssim, OfOneWindowEqualsItsDefinition) {
  const RgbImage a = Noise(11, 11, 3), b = Noise(11, 11, 4);
  double expected = 0;
  for (int c = 0; c < 3; ++c) {
    double sum = 0, ma = 0, mb = 0;
    const auto weight = [](int i) { return std::exp(-(std::pow(i % 11 - 5, 2) + std::pow(i / 11 - 5, 2)) / 4.5); };
    for (int i = 0; i < 121; ++i) {
      sum += weight(i);
      ma += weight(i) * a.rgb[3 * i + c];
      mb += weight(i) * b.rgb[3 * i + c];
    }
    ma /= sum, mb /= sum;
    double va = 0, vb = 0, vab = 0;
    for (int i = 0; i < 121; ++i) {
      const double da = a.rgb[3 * i + c] - ma, db = b.rgb[3 * i + c] - mb, w = weight(i) / sum;
      va += w * da * da, vb += w * db * db, vab += w * da * db;
    }
    expected += (2 * ma * mb + 1e-4) * (2 * vab + 9e-4) / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4)) / 3;
  }
  EXPECT_NEAR(*Ssim(a, b), expected, 1e-13);
}

// Values made once with scikit-image 0.26.0:
//   peak_signal_noise_ratio(a, b, data_range=1)
//   structural_similarity(a, b, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
//                         data_range=1)
TEST(Metrics, AgreeWithScikitImage) {
  struct Case {
    int width, height;
    double psnr, ssim;
  };
  for (const Case& expected :
       {Case{32, 24, 17.33785089789691, 0.8771529871659801}, Case{11, 11, 16.977513932182276, 0.8902805650663993},
        Case{57, 13, 17.481734346542762, 0.9054909708244309}}) {
    RgbImage a = Constant(expected.width, expected.height, 0), b = a;
    for (int y = 0, i = 0; y < a.height; ++y) {
      for (int x = 0; x < a.width; ++x) {
        for (int c = 0; c < 3; ++c, ++i) {
          const int value = (x * 7 + y * 13 + c * 29 + (x * y) % 17 * 5) % 256;
          a.rgb[i] = value / 255.0;
          b.rgb[i] = std::min(255, value + (x * 3 + y * 5 + c * 11) % 64) / 255.0;
        }
      }
    }
    EXPECT_NEAR(Psnr(a, b), expected.psnr, 1e-10);
    EXPECT_NEAR(*Ssim(a, b), expected.ssim, 1e-10);
  }
}

TEST(Metrics, ImagesSmallerThanTheWindowHavePsnrButNoSsim) {
  for (const auto& [width, height] : {std::pair{1, 1}, {10, 100}, {100, 10}}) {
    EXPECT_NEAR(Psnr(Constant(width, height, 0.5), Constant(width, height, 0.6)), 20, 1e-9);
    EXPECT_FALSE(Ssim(Constant(width, height, 0.5), Constant(width, height, 0.6)));
  }
}

TEST(Metrics, RejectEmptyUnequalAndNonFiniteImages) {
  const RgbImage good = Constant(12, 12, 0.5);
  EXPECT_THROW(Psnr(RgbImage{}, RgbImage{}), Error);
  EXPECT_THROW(Psnr(good, Constant(12, 11, 0.5)), Error);
  EXPECT_THROW(Ssim(good, Constant(13, 12, 0.5)), Error);
  for (double bad : {std::nan(""), HUGE_VAL}) {
    RgbImage image = good;
    image.rgb[3 * (5 * 12 + 7) + 1] = bad;
    EXPECT_THROW(Ssim(good, image), Error);
    try {
      Psnr(good, image);
      ADD_FAILURE() << "accepted " << bad;
    } catch (const Error& error) {
      EXPECT_NE(std::string(error.what()).find("x 7, y 5, channel 1"), std::string::npos) << error.what();
    }
  }
}

TEST(ErrorMap, IsBlackWithoutErrorAndBrighterWithMoreUpToItsRange) {
  const auto brightness = [](double error) {
    const std::vector<uint8_t> rgb = ErrorMap(Constant(1, 1, 0.3), Constant(1, 1, 0.3 + error));
    return 0.2126 * rgb[0] + 0.7152 * rgb[1] + 0.0722 * rgb[2];
  };
  EXPECT_LT(brightness(0), 3);
  double last = -1;
  for (int level = 0; level <= 16; ++level) {
    const double now = brightness(kErrorMapRange * level / 16);
    EXPECT_GT(now, last) << level;
    last = now;
  }
  EXPECT_EQ(brightness(kErrorMapRange), brightness(0.6));
}

TEST(ErrorMap, IsRedderThanBlueInTheMiddle) {  // channel order
  const std::vector<uint8_t> rgb = ErrorMap(Constant(1, 1, 0), Constant(1, 1, 0.7 * kErrorMapRange));
  EXPECT_GT(rgb[0], 2 * rgb[2]);
}

const fs::path kNarrow = fs::path(NRFF_SOURCE_DIR) / "tests/data/lpips_narrow.onnx";

// As image() of make_lpips_fixture.py.
RgbImage Pattern(int width, int height, int which) {
  RgbImage image = Constant(width, height, 0);
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) {
      for (int c = 0; c < 3; ++c) {
        const int pixel = (7 * x + 13 * y + 29 * c + which * (x * y / 8 + 11 * c)) % 256;
        image.rgb[3 * (size_t(y) * width + x) + c] = pixel / 255.0;
      }
    }
  }
  return image;
}

RgbImage ToUnit(const Rgb8Image& image) {
  RgbImage unit = Constant(image.width, image.height, 0);
  for (size_t i = 0; i < image.rgb.size(); ++i) unit.rgb[i] = image.rgb[i] / 255.0;
  return unit;
}

TEST(Lpips, IsWhatThePackageComputesWithTheSameNetwork) {
  LpipsNetwork network(kNarrow);
  for (const Json& pair : ReadJson(fs::path(NRFF_SOURCE_DIR) / "tests/data/lpips_narrow.json")) {
    const int width = pair["width"], height = pair["height"];
    const double expected = pair["distance"];
    const auto distance = network.Distance(Pattern(width, height, 0), Pattern(width, height, 1));
    ASSERT_TRUE(distance);
    // Float, over 13 layers.
    EXPECT_NEAR(*distance, expected, 1e-5 * expected) << width << "x" << height;
  }
}

// NRFF_LPIPS: a folder that `make_lpips_fixture.py --full` filled.
TEST(Lpips, IsWhatThePackageComputesWithNetworksOfFullSize) {
  const char* folder = std::getenv("NRFF_LPIPS");
  if (folder == nullptr) GTEST_SKIP() << "NRFF_LPIPS is not set";
  for (const Json& pair : ReadJson(fs::path(folder) / "pairs.json")) {
    LpipsNetwork network(fs::path(folder) / std::string(pair["network"]));
    const auto image = [&](const char* which) { return ToUnit(ReadRgbPng(std::string(pair[which]))); };
    const double expected = pair["distance"], distance = network.Distance(image("truth"), image("rendered")).value();
    EXPECT_NEAR(distance, expected, 1e-6 * expected) << pair;
  }
}

TEST(Lpips, IsZeroForEqualImagesAndNothingForTooSmallOnes) {
  LpipsNetwork network(kNarrow);
  EXPECT_NEAR(network.Distance(Noise(40, 32, 1), Noise(40, 32, 1)).value(), 0, 1e-12);
  EXPECT_FALSE(network.Distance(Noise(40, kLpipsSmallest - 1, 1), Noise(40, kLpipsSmallest - 1, 2)));
  EXPECT_THROW(network.Distance(Noise(40, 32, 1), Noise(32, 40, 1)), Error);
}

TEST(Lpips, ANetworkThatIsNotLpipsOrIsDamagedIsRefusedByName) {
  try {
    ChooseLpips(kNarrow.string());
    FAIL() << "a random backbone was accepted";
  } catch (const Error& error) {
    EXPECT_EQ(error.code(), ExitCode::kInput);
    EXPECT_NE(std::string(error.what()).find("has a random backbone"), std::string::npos) << error.what();
  }
  EXPECT_THROW(ChooseLpips("/nowhere/lpips.onnx"), Error);
  const std::string bytes = ReadFile(kNarrow);
  const fs::path file = fs::temp_directory_path() / ("nrff_lpips_" + std::to_string(getpid()) + ".onnx");
  const auto refusal = [&](const std::string& contents) -> std::string {
    WriteFileAtomically(file, contents);
    try {
      const LpipsNetwork network(file);
      return "accepted";
    } catch (const Error& error) {
      EXPECT_EQ(error.code(), ExitCode::kInput);
      EXPECT_NE(std::string(error.what()).find(file.filename()), std::string::npos) << error.what();
      return error.what();
    }
  };
  const auto replaced = [&](const std::string& from, const std::string& to) {
    std::string changed = bytes;
    return changed.replace(changed.find(from), from.size(), to);
  };
  for (size_t i = 0; i < 64; ++i) EXPECT_NE(refusal(bytes.substr(0, i * bytes.size() / 64)), "accepted") << i;
  EXPECT_NE(refusal(""), "accepted");
  EXPECT_NE(refusal("not ONNX at all"), "accepted");
  std::string flipped = bytes;
  flipped[bytes.size() / 2] ^= 1;  // in a layer's weights
  EXPECT_NE(refusal(flipped).find("damaged"), std::string::npos);
  EXPECT_NE(refusal(replaced("MaxPool", "Softmax")).find("operator Softmax"), std::string::npos);
  EXPECT_NE(refusal(replaced("nrff_lpips", "xrff_lpips")).find("nrff_lpips"), std::string::npos);
  fs::remove(file);
}

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

  void MakeScene(int n_test, int width = 16, int height = 12, int channels = 3,
                 Background background = Background::kNone) {
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
      view.pack_offset = pixels.size();
      view.fx = view.fy = 20, view.cx = width / 2.0, view.cy = height / 2.0;
      view.scene_from_camera = scene.scene_from_world;
      for (size_t i = 0; i < view.PixelBytes(); ++i) {
        pixels.push_back(char(channels == 4 && i % 4 == 3 ? 51 : Pixel(v, i)));
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
      Rgb8Image image{view.width + extra_width, view.height, {}};
      for (size_t i = 0; i < size_t(3) * image.width * image.height; ++i) image.rgb.push_back(make(v, i));
      const std::string path = "rgb/" + view.id + ".png";
      WriteRgbPng(artifact.dir() / path, image);
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
    EXPECT_EQ(ReadRgbPng(dir_ / "eval" / std::string(image["error"])).width, 16);
    const Rgb8Image truth = ReadRgbPng(dir_ / "eval" / std::string(image["truth"]));
    for (size_t i = 0; i < truth.rgb.size(); ++i) ASSERT_EQ(truth.rgb[i], Pixel(v, i));
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
    const Rgb8Image truth = ReadRgbPng(dir_ / "eval" / "truth" / "000001.png");
    for (size_t i = 0; i < truth.rgb.size(); ++i) {
      const double exact = Pixel(1, i / 3 * 4 + i % 3) * 0.2 + behind * 0.8;
      ASSERT_NEAR(truth.rgb[i], exact, 0.5 + 1e-9);
    }
    EXPECT_EQ(result["protocol"]["background"], behind == 255 ? "white" : "black");
  }
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
  EXPECT_THROW(ReadRgbPng(cut), Error);
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
