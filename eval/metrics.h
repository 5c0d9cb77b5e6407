// Image quality as the papers of this field measure it: PSNR and SSIM of a rendered image against the photo.
//
// Images are RGB in [0, 1], double; both of a pair have the same size. Throws InputError for a pair of different sizes,
// an empty image and a value that is not finite.
#pragma once

#include <optional>
#include <vector>

namespace nrff {

struct RgbImage {
  int width = 0, height = 0;  // px
  std::vector<double> rgb;    // [height, width, 3] row-major
};

// Throws as said above.
void CheckPair(const RgbImage& truth, const RgbImage& rendered);

// −10 log10(mean squared error over pixels and channels), dB. Identical images have no error: +infinity.
double Psnr(const RgbImage& truth, const RgbImage& rendered);

// Parameters of SSIM [Wang04], in the variant most papers report: what scikit-image computes with
// gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.
inline constexpr int kSsimWindow = 11;     // px, square
inline constexpr double kSsimSigma = 1.5;  // px, of the Gaussian weights
inline constexpr double kSsimK1 = 0.01, kSsimK2 = 0.03;

// Mean structural similarity over channels and over all pixels whose window lies inside the image ("valid" border).
// Nothing when the image is smaller than the window: then no pixel has one.
std::optional<double> Ssim(const RgbImage& truth, const RgbImage& rendered);

}  // namespace nrff
