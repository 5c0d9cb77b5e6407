#include "model/view_colours.h"

#include <ATen/ATen.h>

#include <algorithm>
#include <cmath>
#include <utility>

#include "pipeline/error.h"
#include "pipeline/statistics.h"

namespace nrff {
namespace {

constexpr size_t kNearest = 4;
constexpr double kAtOnePlace = 1e-3;  // of distance: nearer views count alike

Vec3 Place(const View& view) {
  const Mat4& m = view.scene_from_camera;
  return {m[3], m[7], m[11]};
}
Vec3 Direction(const View& view) {
  const Mat4& m = view.scene_from_camera;
  return {m[2], m[6], m[10]};
}
double Distance(const Vec3& a, const Vec3& b) { return std::hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]); }

double MedianFromMiddle(const std::vector<View>& views) {
  Vec3 middle{};
  for (const View& view : views) {
    for (size_t k = 0; k < 3; ++k) middle[k] += Place(view)[k] / double(views.size());
  }
  std::vector<double> distances;
  for (const View& view : views) distances.push_back(Distance(Place(view), middle));
  const double median = Median(std::move(distances));
  return median > 0 ? median : 1;  // a camera that only turned
}

}  // namespace

ViewColours::ViewColours(const NrffField& field, std::vector<View> training) {
  const int n = field.config().corrected_views;
  if (n == 0) return;
  if (size_t(n) != training.size()) {
    throw InputError("the model has the colours of " + std::to_string(n) + " training views, the scene " +
                     std::to_string(training.size()) + "; render it with the scene that it was trained on");
  }
  training_ = std::move(training);
  corrections_ = field.colour_corrections().detach();
  unit_ = MedianFromMiddle(training_);
}

ColourCorrection ViewColours::Of(const View& view) const {
  std::vector<std::pair<double, size_t>> by_distance;
  for (size_t i = 0; i < training_.size(); ++i) {
    if (!view.id.empty() && training_[i].id == view.id) {
      by_distance = {{0, i}};
      break;
    }
    by_distance.emplace_back(
        Distance(Place(view), Place(training_[i])) / unit_ + Distance(Direction(view), Direction(training_[i])), i);
  }
  const size_t n = std::min(kNearest, by_distance.size());
  std::partial_sort(by_distance.begin(), by_distance.begin() + std::ptrdiff_t(n), by_distance.end());
  const auto* corrections = corrections_.const_data_ptr<float>();
  std::array<double, kCorrectionParameters> sum{};
  double weights = 0;
  for (size_t k = 0; k < n; ++k) {
    const double distance = by_distance[k].first + kAtOnePlace, weight = 1 / (distance * distance);
    weights += weight;
    for (size_t i = 0; i < sum.size(); ++i) {
      sum[i] += weight * corrections[by_distance[k].second * kCorrectionParameters + i];
    }
  }
  ColourCorrection correction;
  for (size_t i = 0; i < sum.size(); ++i) correction[i] = float(sum[i] / weights);
  return correction;
}

void CorrectColours(const ColourCorrection& correction, double background, int64_t n, const float* opacity,
                    float* rgb) {
  for (int64_t i = 0; i < n; ++i) {
    const float behind = 1 - opacity[i];
    float light[3];
    for (int c = 0; c < 3; ++c) light[c] = rgb[3 * i + c] - behind * float(background);
    CorrectedColour(correction.data(), light, behind, float(background), rgb + 3 * i);
  }
}

}  // namespace nrff
