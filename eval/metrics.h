// Image quality as the papers of this field measure it: PSNR and SSIM of a rendered image against the photo.
//
// Images are RGB in [0, 1], double; both of a pair have the same size. Throws InputError for a pair of different sizes,
// an empty image and a value that is not finite.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

namespace nrff {

struct RgbImage {
  int width = 0, height = 0;  // px
  std::vector<double> rgb;    // [height, width, 3] row-major
};

// Which pixels count: [height, width], not 0. nullptr: all.
using Mask = std::vector<uint8_t>;

std::string SizeText(int width, int height);  // "40×32 px"

// Throws as said above.
void CheckPair(const RgbImage& truth, const RgbImage& rendered);

// Over the mask's pixels and their channels. The mask has at least one pixel (else InputError).
double MeanSquaredError(const RgbImage& truth, const RgbImage& rendered, const Mask* mask = nullptr);

// −10 log10(mean squared error), dB. No error: +infinity.
double PsnrOf(double mean_squared_error);
double Psnr(const RgbImage& truth, const RgbImage& rendered, const Mask* mask = nullptr);

// Parameters of SSIM [Wang04], in the variant most papers report: what scikit-image computes with
// gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.
inline constexpr int kSsimWindow = 11;     // px, square
inline constexpr double kSsimSigma = 1.5;  // px, of the Gaussian weights
inline constexpr double kSsimK1 = 0.01, kSsimK2 = 0.03;

// Mean structural similarity over channels and over the mask's pixels whose window lies inside the image ("valid"
// border). Nothing when there is no such pixel, as in an image smaller than the window.
std::optional<double> Ssim(const RgbImage& truth, const RgbImage& rendered, const Mask* mask = nullptr);

}  // namespace nrff
