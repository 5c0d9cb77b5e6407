#include "model/schedule.h"

#include <algorithm>
#include <cmath>

namespace nrff {

double RateFactor(const TrainConfig& config, double progress, double progress_at_reset) {
  return std::pow(config.final_rate, progress - progress_at_reset);
}

int MomentsBehind(const std::vector<double>& moments, double progress) {
  return int(std::upper_bound(moments.begin(), moments.end(), progress) - moments.begin());
}

int StepStage(const TrainConfig& config, double progress) { return MomentsBehind(config.step_moments, progress); }

double MarchingStep(const TrainConfig& config, int stage, const SceneMap& map) {
  const auto& h = map.half_extent;
  const double side = map.unbounded ? 4 : std::cbrt(8 * h[0] * h[1] * h[2]);
  return config.step_ratio * side / config.step_voxels.at(stage);
}

double WeightThreshold(const TrainConfig& config, double progress) {
  const double until = config.weight_threshold_moment;
  const double fraction = until > 0 ? std::min(1., progress / until) : 1.;
  return config.weight_threshold_first *
         std::pow(config.weight_threshold_last / config.weight_threshold_first, fraction);
}

double SettledProgress(const TrainConfig& config) {
  double progress = std::max(0.5, config.weight_threshold_moment);
  for (const auto* moments : {&config.step_moments, &config.occupancy_moments, &config.shrink_moments}) {
    for (const double moment : *moments) progress = std::max(progress, moment);
  }
  return std::min(progress, 1.);
}

double CurveMoment(int index) {
  constexpr double kFirst = 0.01;
  return std::pow(kFirst, 1 - double(index) / (kCurvePoints - 1));
}

}  // namespace nrff
