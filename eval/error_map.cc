#include "eval/error_map.h"

#include <algorithm>
#include <cmath>
#include <opencv2/imgproc.hpp>

namespace nrff {

std::vector<uint8_t> ErrorMap(const RgbImage& truth, const RgbImage& rendered) {
  cv::Mat level(truth.height, truth.width, CV_8UC1);
  for (size_t i = 0; i < level.total(); ++i) {
    double sum = 0;
    for (size_t c = 3 * i; c < 3 * i + 3; ++c) {
      const double difference = truth.rgb[c] - rendered.rgb[c];
      sum += difference * difference;
    }
    level.data[i] = uint8_t(std::lround(255 * std::min(1.0, std::sqrt(sum / 3) / kErrorMapRange)));
  }
  cv::Mat bgr;
  cv::applyColorMap(level, bgr, cv::COLORMAP_INFERNO);
  std::vector<uint8_t> rgb(3 * level.total());
  cv::Mat target(bgr.rows, bgr.cols, CV_8UC3, rgb.data());
  cv::cvtColor(bgr, target, cv::COLOR_BGR2RGB);
  return rgb;
}

}  // namespace nrff
