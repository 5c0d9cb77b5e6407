#include <OpenImageIO/imageio.h>
#include <gtest/gtest.h>
#include <unistd.h>

#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <limits>
#include <random>

#include "eval/error_map.h"
#include "eval/evaluate.h"
#include "eval/image_file.h"
#include "eval/lpips.h"
#include "eval/metrics.h"
#include "eval/work_precision.h"
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

TEST(Metrics, AMaskChoosesThePixelsThatCount) {
  const RgbImage truth = Noise(20, 15, 5);
  RgbImage rendered = truth;
  Mask left(size_t(20) * 15, 0);
  for (size_t y = 0; y < 15; ++y) {
    for (size_t x = 0; x < 20; ++x) {
      left[y * 20 + x] = x < 10 ? 1 : 0;
      for (size_t c = 0; c < 3; ++c) rendered.rgb[3 * (y * 20 + x) + c] += x < 10 ? 0.1 : 0.3;
    }
  }
  EXPECT_NEAR(Psnr(truth, rendered, &left), 20, 1e-9);
  EXPECT_NEAR(MeanSquaredError(truth, rendered), (0.01 + 0.09) / 2, 1e-12);
  const Mask all(left.size(), 1);
  EXPECT_EQ(Psnr(truth, rendered, &all), Psnr(truth, rendered));
  EXPECT_EQ(Ssim(truth, rendered, &all), Ssim(truth, rendered));
  // Exactly one window, the one about (5, 6).
  Mask one(left.size(), 0);
  one[6 * 20 + 5] = 1;
  const auto window = [](const RgbImage& image) {
    RgbImage part = Constant(11, 11, 0);
    for (size_t i = 0; i < part.rgb.size(); ++i) part.rgb[i] = image.rgb[3 * ((i / 33 + 1) * 20) + i % 33];
    return part;
  };
  EXPECT_NEAR(Ssim(truth, rendered, &one).value(), Ssim(window(truth), window(rendered)).value(), 1e-12);
  Mask edge(left.size(), 0);
  edge[0] = 1;  // no window about it
  EXPECT_FALSE(Ssim(truth, rendered, &edge));
  EXPECT_THROW(Psnr(truth, rendered, &(edge = Mask(left.size(), 0))), Error);
  EXPECT_THROW(Psnr(truth, rendered, &(edge = Mask(7, 1))), Error);
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
    const auto image = [&](const char* which) { return ReadImage(std::string(pair[which])).rgb; };
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

TEST(Shrunk, IsTheMeanOfBlocksAndCutsWhatIsLeftOver) {
  RgbImage image = Constant(5, 3, 0);
  for (size_t i = 0; i < image.rgb.size(); ++i) image.rgb[i] = double(i);
  const RgbImage small = Shrunk(image, 2);
  EXPECT_EQ(small.width, 2);
  EXPECT_EQ(small.height, 1);
  // Pixel 1: columns 2 and 3 of rows 0 and 1; channel 2.
  EXPECT_DOUBLE_EQ(small.rgb[3 * 1 + 2], (8 + 11 + 23 + 26) / 4.0);
  EXPECT_EQ(Shrunk(image, 1).rgb, image.rgb);
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
