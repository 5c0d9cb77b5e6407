// Scores of images: closed forms, and sums in long double.

#include <gtest/gtest.h>

#include <cmath>
#include <optional>
#include <random>
#include <string>

#include "eval/metrics.h"
#include "pipeline/error.h"
#include "tests/stability/table.h"

namespace nrff::stability {
namespace {

constexpr double kU = kUnit<double>;
// SSIM's variances are sums over a window, rounded some 24 times along rows and columns, of squares of up to 1, four of
// them; their error counts against c₂.
constexpr double kSsimBound = 4 * 24 * kU / (kSsimK2 * kSsimK2);

RgbImage Constant(int width, int height, double value) {
  return {width, height, std::vector<double>(size_t(width) * height * 3, value)};
}

TEST(Metrics, IdenticalAndConstantImages) {
  const RgbImage grey = Constant(40, 30, 0.4), other = Constant(40, 30, 0.7);
  Hold("metrics", "PSNR of identical images", "infinite", Psnr(grey, grey) == HUGE_VAL ? 0 : 1, 0);
  Hold("metrics", "1 − SSIM of identical images", "constant", std::abs(1 - *Ssim(grey, grey)), 16 * kU);
  Hold("metrics", "PSNR of constants 0.4 and 0.7", "dB, −20 log10 0.3",
       std::abs(Psnr(grey, other) + 20 * std::log10(0.3)), 10 / std::log(10) * (40 * 30 * 3 + 8) * kU);
  const double c1 = kSsimK1 * kSsimK1;
  Hold("metrics", "SSIM of constants 0.4 and 0.7", "(2ab + c₁)/(a² + b² + c₁)",
       std::abs(*Ssim(grey, other) - (2 * 0.4 * 0.7 + c1) / (0.16 + 0.49 + c1)), kSsimBound);
  const RgbImage dot = Constant(1, 1, 0.5);
  Hold("metrics", "SSIM of an image smaller than its window", "none, 1 × 1", Ssim(dot, dot) ? 1 : 0, 0);
  Hold("metrics", "PSNR of black and white", "0 dB, 1 × 1", std::abs(Psnr(Constant(1, 1, 0), Constant(1, 1, 1))), 0);
}

TEST(Metrics, NumbersThatAreNoneAreRefused) {
  double accepted = 0;
  for (const double bad : {std::nan(""), HUGE_VAL, -HUGE_VAL}) {
    RgbImage image = Constant(12, 12, 0.5);
    image.rgb[77] = bad;
    for (const bool ssim : {false, true}) {
      try {
        ssim ? (void)Ssim(Constant(12, 12, 0.5), image) : (void)Psnr(Constant(12, 12, 0.5), image);
        ++accepted;
      } catch (const Error&) {
      }
    }
  }
  Hold("metrics", "images with a NaN or infinite pixel that are scored", "PSNR and SSIM", accepted, 0);
}

// One level of 16 bits apart: squares of 1.5e-5 beside values of 1.
TEST(Metrics, ErrorsOfOneLevelOf16Bits) {
  std::mt19937 random(1);
  RgbImage truth = Constant(200, 150, 0), rendered = truth;
  long double sum = 0;
  for (size_t i = 0; i < truth.rgb.size(); ++i) {
    const auto level = double(random() % 65535);
    truth.rgb[i] = level / 65535;
    rendered.rgb[i] = (level + double(random() % 2)) / 65535;
    const long double difference = static_cast<long double>(truth.rgb[i]) - rendered.rgb[i];
    sum += difference * difference;
  }
  const double n = double(truth.rgb.size()), exact = double(sum / static_cast<long double>(n));
  Hold("metrics", "mean squared error, of itself", "16-bit levels 0 or 1 apart",
       std::abs(MeanSquaredError(truth, rendered) - exact) / exact, (n + 8) * kU);
}

// SSIM needs the variance of values near 1 that vary by 1e-4: E[x²] − E[x]² loses 8 of 16 digits, which c₂ = 9e-4
// hides.
TEST(Metrics, SsimOfBrightFlatImages) {
  std::mt19937 random(2);
  std::uniform_real_distribution<double> noise(-1e-4, 1e-4);
  RgbImage truth = Constant(32, 32, 0.999), rendered = truth;
  for (size_t i = 0; i < truth.rgb.size(); ++i) {
    truth.rgb[i] += noise(random);
    rendered.rgb[i] += noise(random);
  }
  std::vector<long double> window(kSsimWindow);
  long double total = 0;
  for (int k = 0; k < kSsimWindow; ++k) {
    const int off = k - kSsimWindow / 2;
    window[k] = std::exp(-0.5L * off * off / (kSsimSigma * kSsimSigma));
    total += window[k];
  }
  const long double c1 = kSsimK1 * kSsimK1, c2 = kSsimK2 * kSsimK2;
  long double sum = 0;
  int n = 0;
  for (int c = 0; c < 3; ++c) {
    for (int y = 0; y + kSsimWindow <= 32; ++y) {
      for (int x = 0; x + kSsimWindow <= 32; ++x, ++n) {
        // Two passes: means first, then what deviates from them.
        long double mean_a = 0, mean_b = 0, aa = 0, bb = 0, ab = 0;
        for (const bool deviations : {false, true}) {
          for (int i = 0; i < kSsimWindow; ++i) {
            for (int j = 0; j < kSsimWindow; ++j) {
              const long double weight = window[i] * window[j] / (total * total);
              const size_t at = (size_t(y + i) * 32 + x + j) * 3 + c;
              const long double a = truth.rgb[at], b = rendered.rgb[at];
              if (!deviations) {
                mean_a += weight * a;
                mean_b += weight * b;
              } else {
                aa += weight * (a - mean_a) * (a - mean_a);
                bb += weight * (b - mean_b) * (b - mean_b);
                ab += weight * (a - mean_a) * (b - mean_b);
              }
            }
          }
        }
        sum += (2 * mean_a * mean_b + c1) * (2 * ab + c2) / ((mean_a * mean_a + mean_b * mean_b + c1) * (aa + bb + c2));
      }
    }
  }
  Hold("metrics", "SSIM", "values of 0.999 ± 1e-4", std::abs(*Ssim(truth, rendered) - double(sum / n)), kSsimBound);
}

}  // namespace
}  // namespace nrff::stability
