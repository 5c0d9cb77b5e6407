// Scores of views whose exposure and white balance nothing tells.
#include "eval/colour_fit.h"

#include <gtest/gtest.h>

#include <cmath>
#include <random>

namespace nrff {
namespace {

RgbImage Noise(int width, int height) {
  std::mt19937 random(3);
  std::uniform_real_distribution<double> value(0.1, 0.6);
  RgbImage image{width, height, {}};
  for (int i = 0; i < 3 * width * height; ++i) image.rgb.push_back(value(random));
  return image;
}

// Exposure, white balance, a mixture of channels and a veil of light.
RgbImage Photographed(const RgbImage& image) {
  RgbImage photo = image;
  for (size_t p = 0; p < photo.rgb.size(); p += 3) {
    const double r = image.rgb[p], g = image.rgb[p + 1], b = image.rgb[p + 2];
    photo.rgb[p] = 1.3 * r + 0.02;
    photo.rgb[p + 1] = 1.1 * g + 0.05 * r;
    photo.rgb[p + 2] = 0.8 * b;
  }
  return photo;
}

TEST(ColourFit, TakesOutAnAffineMapAndNothingElse) {
  const RgbImage rendered = Noise(40, 30);
  RgbImage photo = Photographed(rendered);
  const auto fit = FitColours(photo, rendered);
  ASSERT_TRUE(fit);
  EXPECT_LT(fit->psnr_before, 25);
  EXPECT_GT(fit->psnr_after, 80);

  // What is wrong in the right half alone stays wrong.
  for (size_t p = 0; p < photo.rgb.size(); ++p) {
    if ((p / 3) % 40 >= 20) photo.rgb[p] += 0.1;
  }
  EXPECT_NEAR(FitColours(photo, rendered)->psnr_after, 20, 0.05);
}

TEST(ColourFit, WhatIsEqualStaysEqual) {
  const RgbImage image = Noise(40, 30);
  const auto fit = FitColours(image, image);
  ASSERT_TRUE(fit);
  EXPECT_TRUE(std::isinf(fit->psnr_before) && std::isinf(fit->psnr_after));
}

TEST(ColourFit, AHalfOfOneColourIsNoReasonForNonsense) {
  RgbImage rendered = Noise(40, 30);
  for (size_t p = 0; p < rendered.rgb.size(); ++p) {
    if ((p / 3) % 40 < 20) rendered.rgb[p] = 1;
  }
  const auto fit = FitColours(rendered, rendered);
  ASSERT_TRUE(fit);
  EXPECT_TRUE(std::isinf(fit->psnr_after));
  RgbImage photo = rendered;
  for (double& value : photo.rgb) value *= 0.9;
  EXPECT_GT(FitColours(photo, rendered)->psnr_after, 20);
}

TEST(ColourFit, OfMaskedPixelsAlone) {
  const RgbImage rendered = Noise(40, 30);
  RgbImage photo = Photographed(rendered);
  Mask mask(40 * 30, 1);
  for (size_t p = 0; p < mask.size(); p += 3) {
    mask[p] = 0;
    for (size_t c = 0; c < 3; ++c) photo.rgb[3 * p + c] = 1;
  }
  EXPECT_LT(FitColours(photo, rendered)->psnr_after, 30);
  EXPECT_GT(FitColours(photo, rendered, &mask)->psnr_after, 80);
  for (size_t p = 0; p < mask.size(); ++p) mask[p] = p % 40 < 20 ? 0 : 1;
  EXPECT_FALSE(FitColours(photo, rendered, &mask));
}

}  // namespace
}  // namespace nrff
