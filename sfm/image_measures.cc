#include "sfm/image_measures.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <numeric>
#include <opencv2/imgproc.hpp>

namespace nrff {
namespace {

constexpr int kBlurSide_px = 512;
constexpr double kFrame = 0.02;  // of the shorter side
constexpr int kNearlyWhite = 230, kNearlyBlack = 25;
constexpr double kPlainShare = 0.7;
constexpr int kHashSide = 16;
constexpr size_t kMaxBitsApart = 2;
constexpr double kMaxMeanGap = 3;

cv::Mat ToGrey(const Image& image) {
  const cv::Mat colour(image.height, image.width, CV_8UC(image.channels), const_cast<uint8_t*>(image.pixels.data()));
  cv::Mat grey;
  cv::cvtColor(colour, grey, image.channels == 4 ? cv::COLOR_RGBA2GRAY : cv::COLOR_RGB2GRAY);
  return grey;
}

// A name cut at its last run of digits.
struct NumberedName {
  std::string before, after;
  uint64_t number = 0;
};

std::optional<NumberedName> CutAtLastNumber(const std::string& name) {
  constexpr char kDigits[] = "0123456789";
  const size_t last = std::filesystem::path(name).replace_extension().native().find_last_of(kDigits);
  if (last == std::string::npos) return {};
  const size_t before_first = name.find_last_not_of(kDigits, last);
  const size_t first = before_first == std::string::npos ? 0 : before_first + 1;
  NumberedName cut{name.substr(0, first), name.substr(last + 1), 0};
  if (std::from_chars(&name[first], &name[last] + 1, cut.number).ec != std::errc()) return {};
  return cut;
}

bool NumbersGrowSteadily(const std::vector<std::filesystem::path>& paths) {
  std::vector<NumberedName> names;
  for (const std::filesystem::path& path : paths) {
    auto cut = CutAtLastNumber(path.native());
    if (!cut) return false;
    if (!names.empty()) {
      const NumberedName& previous = names.back();
      if (cut->before != previous.before || cut->after != previous.after || cut->number <= previous.number)
        return false;
    }
    names.push_back(std::move(*cut));
  }
  const double span = static_cast<double>(names.back().number - names.front().number);
  return span <= kMaxMeanGap * static_cast<double>(names.size() - 1);
}

}  // namespace

double MeasureBlur(const Image& image) {
  cv::Mat grey = ToGrey(image);
  const double scale = static_cast<double>(kBlurSide_px) / std::max(grey.cols, grey.rows);
  if (scale < 1) {
    const cv::Size size(std::max(1, cvRound(grey.cols * scale)), std::max(1, cvRound(grey.rows * scale)));
    cv::resize(grey, grey, size, 0, 0, cv::INTER_AREA);
  }
  cv::Mat laplacian;
  cv::Laplacian(grey, laplacian, CV_64F);
  cv::Scalar mean, deviation;
  cv::meanStdDev(laplacian, mean, deviation);
  return deviation[0] * deviation[0];
}

FrameShares MeasureFrame(const Image& image) {
  const int margin = std::max(1, int(std::lround(kFrame * std::min(image.width, image.height))));
  int64_t n = 0, n_white = 0, n_black = 0;
  for (int y = 0; y < image.height; ++y) {
    const bool whole_row = y < margin || y >= image.height - margin;
    for (int x = 0; x < image.width; ++x) {
      if (!whole_row && x == margin) x = std::max(x, image.width - margin);  // over the inside
      const uint8_t* p = &image.pixels[(size_t(y) * image.width + x) * image.channels];
      const auto [darkest, brightest] = std::minmax({p[0], p[1], p[2]});
      ++n;
      n_white += darkest >= kNearlyWhite;
      n_black += brightest <= kNearlyBlack;
    }
  }
  return {double(n_white) / double(n), double(n_black) / double(n)};
}

Background PlainBackground(const std::vector<FrameShares>& frames) {
  if (frames.empty()) return Background::kNone;
  const auto median = [&](double FrameShares::*share) {
    std::vector<double> values;
    values.reserve(frames.size());
    for (const FrameShares& frame : frames) values.push_back(frame.*share);
    std::nth_element(values.begin(), values.begin() + std::ptrdiff_t(values.size() / 2), values.end());
    return values[values.size() / 2];
  };
  if (median(&FrameShares::white) >= kPlainShare) return Background::kWhite;
  if (median(&FrameShares::black) >= kPlainShare) return Background::kBlack;
  return Background::kNone;
}

DifferenceHash HashDifferences(const Image& image) {
  cv::Mat small;
  cv::resize(ToGrey(image), small, cv::Size(kHashSide + 1, kHashSide), 0, 0, cv::INTER_AREA);
  DifferenceHash hash;
  for (int y = 0; y < kHashSide; ++y) {
    for (int x = 0; x < kHashSide; ++x) hash[y * kHashSide + x] = small.at<uint8_t>(y, x) > small.at<uint8_t>(y, x + 1);
  }
  return hash;
}

std::vector<std::vector<int>> GroupAlike(const std::vector<DifferenceHash>& hashes) {
  const int n = static_cast<int>(hashes.size());
  std::vector<int> group(n);  // smallest index known to be alike
  std::iota(group.begin(), group.end(), 0);
  for (int i = 0; i < n; ++i) {
    for (int j = i + 1; j < n; ++j) {
      if (group[i] == group[j] || (hashes[i] ^ hashes[j]).count() > kMaxBitsApart) continue;
      std::replace(group.begin(), group.end(), std::max(group[i], group[j]), std::min(group[i], group[j]));
    }
  }
  std::vector<std::vector<int>> members(n);
  for (int i = 0; i < n; ++i) members[group[i]].push_back(i);
  std::erase_if(members, [](const std::vector<int>& indices) { return indices.size() < 2; });
  return members;
}

bool IsOrdered(const std::vector<std::filesystem::path>& paths,
               const std::vector<std::optional<std::string>>& timestamps) {
  if (paths.empty()) return false;
  const bool all_stamped =
      std::all_of(timestamps.begin(), timestamps.end(), [](const auto& time) { return time.has_value(); });
  if (all_stamped && timestamps.front() != timestamps.back()) {
    return std::is_sorted(timestamps.begin(), timestamps.end());  // "YYYY:MM:DD hh:mm:ss" sorts as text
  }
  if (all_stamped &&
      std::adjacent_find(timestamps.begin(), timestamps.end(), std::not_equal_to<>()) != timestamps.end()) {
    return false;
  }
  return NumbersGrowSteadily(paths);
}

}  // namespace nrff
