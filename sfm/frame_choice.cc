#include "sfm/frame_choice.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>

namespace nrff {
namespace {

constexpr double kStandingStill = 0.002;  // longer sides: less than a pixel of the small pictures that are measured
constexpr double kBlurred = 0.6;          // of the sharpness of the frame kept instead
constexpr double kAllBlurred = 0.35;      // of the median of the frames kept around: none of its stretch is kept
constexpr int kAround = 4;                // on each side
constexpr double kMiddle = 0.3;           // by so much less counts the sharpness at a stretch's ends

double MedianSharpnessAround(const std::vector<FrameMeasure>& frames, const std::vector<size_t>& kept, size_t i) {
  std::vector<double> around;
  for (size_t j = i < kAround ? 0 : i - kAround; j < std::min(kept.size(), i + kAround + 1); ++j) {
    if (j != i) around.push_back(frames[kept[j]].sharpness);
  }
  if (around.empty()) return 0;
  const auto median = around.begin() + std::ptrdiff_t(around.size() / 2);
  std::nth_element(around.begin(), median, around.end());
  return *median;
}

}  // namespace

std::vector<FrameVerdict> ChooseFrames(const std::vector<FrameMeasure>& frames, int n_wanted) {
  std::vector<FrameVerdict> verdicts(frames.size(), FrameVerdict::kNear);
  if (frames.empty()) return verdicts;
  std::vector<double> position(frames.size());  // along the video's motion
  for (size_t i = 1; i < frames.size(); ++i) position[i] = position[i - 1] + frames[i].motion;
  const double total = position.back();
  int n = n_wanted;
  if (n <= 0) n = std::clamp(int(std::lround(total / kMotionPerFrame)) + 1, kFewestFrames, kMostFrames);
  n = std::min(n, int(frames.size()));
  const double stretch = total / n;

  const auto stretch_of = [&](size_t i) { return stretch > 0 ? std::min(n - 1, int(position[i] / stretch)) : 0; };
  std::vector<std::optional<size_t>> best(static_cast<size_t>(n));
  const auto score = [&](size_t i) {
    const double off = stretch > 0 ? std::abs(2 * (position[i] / stretch - stretch_of(i)) - 1) : 0;
    return frames[i].sharpness * (1 - kMiddle * std::min(off, 1.));
  };
  for (size_t i = 0; i < frames.size(); ++i) {
    std::optional<size_t>& of_stretch = best[size_t(stretch_of(i))];
    if (!of_stretch || score(i) > score(*of_stretch)) of_stretch = i;
  }
  const double least_gap = std::max(0.3 * stretch, kStandingStill);
  std::vector<size_t> kept;
  for (const std::optional<size_t>& frame : best) {
    if (!frame) continue;  // passed over by a fast motion
    if (kept.empty() || position[*frame] - position[kept.back()] >= least_gap) {
      kept.push_back(*frame);
    } else if (frames[*frame].sharpness > frames[kept.back()].sharpness) {
      kept.back() = *frame;
    }
  }
  // A motion by leaps leaves stretches without a frame: others give a second one.
  while (int(kept.size()) < n) {
    std::optional<size_t> next;
    double most = 0;
    for (size_t i = 0; i < frames.size(); ++i) {
      const auto after = std::lower_bound(kept.begin(), kept.end(), i);
      double gap = std::numeric_limits<double>::infinity(), sharpness = 0;
      for (const auto neighbour : {after, after == kept.begin() ? kept.end() : after - 1}) {
        if (neighbour == kept.end()) continue;
        gap = std::min(gap, std::abs(position[*neighbour] - position[i]));
        sharpness = std::max(sharpness, frames[*neighbour].sharpness);
      }
      const double worth = std::min(gap, stretch) * frames[i].sharpness;
      if (gap >= least_gap && frames[i].sharpness >= kBlurred * sharpness && worth > most) {
        most = worth;
        next = i;
      }
    }
    if (!next) break;
    kept.insert(std::lower_bound(kept.begin(), kept.end(), *next), *next);
  }
  std::vector<bool> sharp(kept.size());
  for (size_t i = 0; i < kept.size(); ++i) {
    sharp[i] = frames[kept[i]].sharpness >= kAllBlurred * MedianSharpnessAround(frames, kept, i);
  }

  size_t nearest = 0;  // of the kept ones
  for (size_t i = 0; i < frames.size(); ++i) {
    while (nearest + 1 < kept.size() &&
           std::abs(position[kept[nearest + 1]] - position[i]) <= std::abs(position[kept[nearest]] - position[i])) {
      ++nearest;
    }
    const bool still =
        frames[i].motion < kStandingStill || (i + 1 < frames.size() && frames[i + 1].motion < kStandingStill);
    if (kept[nearest] == i) {
      verdicts[i] = sharp[nearest] ? FrameVerdict::kKept : FrameVerdict::kBlurred;
    } else if (!sharp[nearest] || frames[i].sharpness < kBlurred * frames[kept[nearest]].sharpness) {
      verdicts[i] = FrameVerdict::kBlurred;
    } else if (still && i > 0) {
      verdicts[i] = FrameVerdict::kRepeated;
    }
  }
  return verdicts;
}

}  // namespace nrff
