// What is measured of a pair of images: PSNR, SSIM, LPIPS, error pictures.
#include "eval/metrics.h"

#include <gtest/gtest.h>
#include <unistd.h>

#include <cmath>
#include <cstdlib>
#include <limits>

#include "eval/error_map.h"
#include "eval/image_file.h"
#include "eval/lpips.h"
#include "eval/score.h"
#include "eval/work_precision.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"
#include "tests/eval_fixture.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

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

}  // namespace
}  // namespace nrff
