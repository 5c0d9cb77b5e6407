#include "sfm/video_measures.h"

#include <algorithm>
#include <cmath>
#include <opencv2/imgproc.hpp>

namespace nrff {
namespace {

constexpr int kBlocks = 4;               // on each side
constexpr double kFewestResponse = 0.1;  // of a phase correlation's peak: less is noise
constexpr double kPlain = 4;             // grey levels: blocks of less deviation show nothing that moves

cv::Mat View(const GreyPicture& picture) {
  return {picture.height, picture.width, CV_8UC1, const_cast<uint8_t*>(picture.pixels.data())};
}

double Deviation(const cv::Mat& values) {
  cv::Scalar mean, deviation;
  cv::meanStdDev(values, mean, deviation);
  return deviation[0];
}

}  // namespace

double MeasureSharpness(const GreyPicture& picture) {
  const cv::Mat grey = View(picture);
  cv::Mat edges;
  cv::Laplacian(grey, edges, CV_32F);
  const double contrast = Deviation(grey), detail = Deviation(edges);
  return contrast > 0 ? detail * detail / (contrast * contrast) : 0;
}

double MeasureMotion(const GreyPicture& before, const GreyPicture& after) {
  cv::Mat from, to;
  View(before).convertTo(from, CV_32F);
  View(after).convertTo(to, CV_32F);
  const cv::Size block(before.width / kBlocks, before.height / kBlocks);
  if (block.width < 8 || block.height < 8) return 0;
  cv::Mat window;
  cv::createHanningWindow(window, block, CV_32F);
  std::vector<double> shifts;
  for (int i = 0; i < kBlocks * kBlocks; ++i) {
    const cv::Rect part(cv::Point(i % kBlocks * block.width, i / kBlocks * block.height), block);
    if (Deviation(from(part)) < kPlain || Deviation(to(part)) < kPlain) continue;
    double response = 0;
    const cv::Point2d shift = cv::phaseCorrelate(from(part), to(part), window, &response);
    if (response >= kFewestResponse) shifts.push_back(std::hypot(shift.x, shift.y));
  }
  const double longer = std::max(before.width, before.height);
  // Nothing found again: another scene, or faster than blocks can tell.
  if (shifts.empty()) return Deviation(from - to) < kPlain ? 0 : double(block.width) / longer;
  const auto median = shifts.begin() + std::ptrdiff_t(shifts.size() / 2);
  std::nth_element(shifts.begin(), median, shifts.end());
  return *median / longer;
}

}  // namespace nrff
