#include "eval/metrics.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <string>

#include "pipeline/error.h"

namespace nrff {
namespace {

constexpr int kChannels = 3;

std::string SizeText(const RgbImage& image) { return nrff::SizeText(image.width, image.height); }

void CheckImage(const RgbImage& image, const char* what) {
  const size_t expected = image.width > 0 && image.height > 0 ? size_t(image.width) * image.height * kChannels : 0;
  if (expected == 0 || image.rgb.size() != expected) {
    throw InputError(std::string("The ") + what + " image is " + SizeText(image) + " with " +
                     std::to_string(image.rgb.size()) +
                     " values; a comparison needs at least one pixel and three values for each.");
  }
  for (size_t i = 0; i < expected; ++i) {
    if (std::isfinite(image.rgb[i])) continue;
    const size_t pixel = i / kChannels;
    throw InputError(std::string("The ") + what + " image holds " + std::to_string(image.rgb[i]) + " at x " +
                     std::to_string(pixel % image.width) + ", y " + std::to_string(pixel / image.width) + ", channel " +
                     std::to_string(i % kChannels) + "; only finite values can be compared.");
  }
}

void CheckMask(const Mask* mask, const RgbImage& image) {
  if (mask == nullptr || mask->size() == size_t(image.width) * image.height) return;
  throw InputError("A mask of " + std::to_string(mask->size()) + " pixels does not fit an image of " + SizeText(image) +
                   "; both must have the same size.");
}

std::array<double, kSsimWindow> GaussianWeights() {
  constexpr int kRadius = kSsimWindow / 2;
  std::array<double, kSsimWindow> weights{};
  double sum = 0;
  for (int i = 0; i < kSsimWindow; ++i) {
    const double distance = (i - kRadius) / kSsimSigma;
    sum += weights[i] = std::exp(-0.5 * distance * distance);
  }
  for (double& weight : weights) weight /= sum;
  return weights;
}

// Weighted means over the windows that lie inside: [height, width·3] → [height − 10, (width − 10)·3].
std::vector<double> FilterValid(const std::vector<double>& values, int width, int height) {
  static const std::array<double, kSsimWindow> kWeights = GaussianWeights();
  const size_t row = size_t(width) * kChannels;
  const size_t out_row = row - size_t(kSsimWindow - 1) * kChannels;
  const int out_height = height - (kSsimWindow - 1);
  std::vector<double> out(out_row * out_height, 0.0);
  std::vector<double> column_means(row);
  for (int y = 0; y < out_height; ++y) {
    std::fill(column_means.begin(), column_means.end(), 0.0);
    for (int k = 0; k < kSsimWindow; ++k) {
      const double* source = values.data() + (size_t(y) + k) * row;
      for (size_t i = 0; i < row; ++i) column_means[i] += kWeights[k] * source[i];
    }
    double* target = out.data() + y * out_row;
    for (int k = 0; k < kSsimWindow; ++k) {
      const double* source = column_means.data() + size_t(k) * kChannels;
      for (size_t i = 0; i < out_row; ++i) target[i] += kWeights[k] * source[i];
    }
  }
  return out;
}

std::vector<double> Product(const std::vector<double>& a, const std::vector<double>& b) {
  std::vector<double> product(a.size());
  for (size_t i = 0; i < a.size(); ++i) product[i] = a[i] * b[i];
  return product;
}

}  // namespace

std::string SizeText(int width, int height) { return std::to_string(width) + "×" + std::to_string(height) + " px"; }

void CheckPair(const RgbImage& truth, const RgbImage& rendered) {
  CheckImage(truth, "true");
  CheckImage(rendered, "rendered");
  if (truth.width != rendered.width || truth.height != rendered.height) {
    throw InputError("The true image is " + SizeText(truth) + " but the rendered one " + SizeText(rendered) +
                     "; both must have the same size.");
  }
}

double MeanSquaredError(const RgbImage& truth, const RgbImage& rendered, const Mask* mask) {
  CheckPair(truth, rendered);
  CheckMask(mask, truth);
  double sum = 0;
  size_t n_values = 0;
  for (size_t i = 0; i < truth.rgb.size(); ++i) {
    if (mask != nullptr && (*mask)[i / kChannels] == 0) continue;
    const double difference = truth.rgb[i] - rendered.rgb[i];
    sum += difference * difference;
    ++n_values;
  }
  if (n_values == 0) throw InputError("The mask leaves no pixel to compare; give one that is not empty.");
  return sum / double(n_values);
}

double PsnrOf(double mean_squared_error) {
  return mean_squared_error == 0 ? std::numeric_limits<double>::infinity() : -10 * std::log10(mean_squared_error);
}

double Psnr(const RgbImage& truth, const RgbImage& rendered, const Mask* mask) {
  return PsnrOf(MeanSquaredError(truth, rendered, mask));
}

std::optional<double> Ssim(const RgbImage& truth, const RgbImage& rendered, const Mask* mask) {
  CheckPair(truth, rendered);
  CheckMask(mask, truth);
  const int width = truth.width, height = truth.height;
  if (width < kSsimWindow || height < kSsimWindow) return std::nullopt;

  const std::vector<double> mean_a = FilterValid(truth.rgb, width, height);
  const std::vector<double> mean_b = FilterValid(rendered.rgb, width, height);
  const std::vector<double> mean_aa = FilterValid(Product(truth.rgb, truth.rgb), width, height);
  const std::vector<double> mean_bb = FilterValid(Product(rendered.rgb, rendered.rgb), width, height);
  const std::vector<double> mean_ab = FilterValid(Product(truth.rgb, rendered.rgb), width, height);

  constexpr double kC1 = kSsimK1 * kSsimK1, kC2 = kSsimK2 * kSsimK2;
  constexpr size_t kRadius = kSsimWindow / 2;
  const size_t out_width = size_t(width) - 2 * kRadius;
  double sum = 0;
  size_t n_values = 0;
  for (size_t i = 0; i < mean_a.size(); ++i) {
    if (mask != nullptr) {
      const size_t x = i / kChannels % out_width + kRadius, y = i / kChannels / out_width + kRadius;
      if ((*mask)[y * width + x] == 0) continue;
    }
    ++n_values;
    const double a = mean_a[i], b = mean_b[i];
    const double variance_sum = mean_aa[i] - a * a + mean_bb[i] - b * b;
    const double covariance = mean_ab[i] - a * b;
    sum += (2 * a * b + kC1) * (2 * covariance + kC2) / ((a * a + b * b + kC1) * (variance_sum + kC2));
  }
  if (n_values == 0) return std::nullopt;
  return sum / double(n_values);
}

}  // namespace nrff
