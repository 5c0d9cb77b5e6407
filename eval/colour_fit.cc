#include "eval/colour_fit.h"

#include <algorithm>
#include <opencv2/core.hpp>

namespace nrff {
namespace {

// Of the squared differences of a pixel: enough to settle what a half of one colour leaves open, far too little to be
// seen elsewhere.
constexpr double kRidge = 1e-6;

}  // namespace

std::optional<ColourFit> FitColours(const RgbImage& truth, const RgbImage& rendered, const Mask* mask) {
  CheckPair(truth, rendered);
  const auto counts = [&](size_t pixel) { return mask == nullptr || (*mask)[pixel] != 0; };
  const auto width = size_t(rendered.width);
  cv::Matx44d squares = cv::Matx44d::zeros();
  cv::Matx<double, 4, 3> products = cv::Matx<double, 4, 3>::zeros();
  Mask right(rendered.rgb.size() / 3);
  size_t n_left = 0;
  for (size_t p = 0; p < right.size(); ++p) {
    if (!counts(p)) continue;
    if (2 * (p % width) + 1 >= width) {
      right[p] = 1;
      continue;
    }
    ++n_left;
    const cv::Vec4d from(rendered.rgb[3 * p], rendered.rgb[3 * p + 1], rendered.rgb[3 * p + 2], 1);
    const cv::Vec3d off(truth.rgb[3 * p] - from[0], truth.rgb[3 * p + 1] - from[1], truth.rgb[3 * p + 2] - from[2]);
    squares += from * from.t();
    products += from * off.t();
  }
  if (n_left == 0 || std::count(right.begin(), right.end(), 1) == 0) return {};
  squares += kRidge * double(n_left) * cv::Matx44d::eye();
  const cv::Matx<double, 4, 3> map = squares.solve(products, cv::DECOMP_CHOLESKY);  // what is added
  RgbImage fitted = rendered;
  for (size_t p = 0; p < right.size(); ++p) {
    const cv::Vec4d from(rendered.rgb[3 * p], rendered.rgb[3 * p + 1], rendered.rgb[3 * p + 2], 1);
    for (int c = 0; c < 3; ++c) {
      const double added = map(0, c) * from[0] + map(1, c) * from[1] + map(2, c) * from[2] + map(3, c);
      fitted.rgb[3 * p + size_t(c)] = std::clamp(from[c] + added, 0., 1.);
    }
  }
  return ColourFit{Psnr(truth, rendered, &right), Psnr(truth, fitted, &right)};
}

}  // namespace nrff
