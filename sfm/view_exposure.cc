#include "sfm/view_exposure.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>

namespace nrff {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr int kPatch = 1;                       // px on every side of a point: pixel noise and resampling average out
constexpr int kDarkest = 12, kBrightest = 243;  // of 255: beyond, values are clipped or mostly noise
constexpr double kCauchy = 0.1;  // log units: larger differences are highlights, occlusions, wrong matches
constexpr double kPrior = 0.01;  // as of so many sightings that a view has a gain of 1
constexpr int kIterations = 20;
constexpr size_t kFewestSightings = 30;  // of a training view on average; fewer points say little of exposures

// One point in one view.
struct Sighting {
  size_t view;  // index into the training views
  double log_rgb[3];
};

// Mean colour around a place; nothing where a pixel is outside, transparent or clipped.
std::optional<Sighting> Look(const View& view, const uint8_t* pixels, double x, double y) {
  if (!(x >= kPatch && y >= kPatch && x < view.width - kPatch && y < view.height - kPatch)) return {};
  const int ix = int(x), iy = int(y);
  double sum[3] = {};
  for (int v = iy - kPatch; v <= iy + kPatch; ++v) {
    for (int u = ix - kPatch; u <= ix + kPatch; ++u) {
      const uint8_t* pixel = pixels + (int64_t(v) * view.width + u) * view.channels;
      if (view.channels == 4 && pixel[3] < 255) return {};
      for (int c = 0; c < 3; ++c) {
        if (pixel[c] < kDarkest || pixel[c] > kBrightest) return {};
        sum[c] += pixel[c];
      }
    }
  }
  Sighting sighting{};
  for (int c = 0; c < 3; ++c) sighting.log_rgb[c] = std::log(sum[c]);
  return sighting;
}

using Track = std::vector<Sighting>;

std::vector<Track> TrainingTracks(const ColmapModel& model, const std::map<uint32_t, uint32_t>& view_of_image,
                                  const Scene& scene, const ImagePack& pack, const std::vector<int>& training) {
  std::map<uint32_t, size_t> index_of_view;
  for (size_t i = 0; i < training.size(); ++i) index_of_view[uint32_t(training[i])] = i;
  std::vector<Track> tracks;
  for (const auto& [id, point] : model.points) {
    std::map<size_t, Sighting> by_view;
    for (const auto& [image_id, observation] : point.track) {
      const auto view = view_of_image.find(image_id);
      if (view == view_of_image.end()) continue;
      const auto index = index_of_view.find(view->second);
      if (index == index_of_view.end()) continue;
      const ColmapObservation& at = model.images.at(image_id).observations[observation];
      const View& seen = scene.views[view->second];
      if (auto sighting = Look(seen, pack.Pixels(seen), at.x, at.y)) {
        sighting->view = index->second;
        by_view.emplace(index->second, *sighting);
      }
    }
    if (by_view.size() < 2) continue;
    Track& track = tracks.emplace_back();
    for (const auto& [view, sighting] : by_view) track.push_back(sighting);
  }
  return tracks;
}

// The points' colours given the gains, then the gains by normal equations from which the points are eliminated, until
// the weights have settled.
VectorXd LogGains(const std::vector<Track>& tracks, size_t n_views, int channel) {
  VectorXd gains = VectorXd::Zero(Eigen::Index(n_views));
  std::vector<double> colours(tracks.size()), weights;
  const auto measured = [&](const Sighting& s) { return s.log_rgb[channel] - gains[Eigen::Index(s.view)]; };
  for (int iteration = 0; iteration < kIterations; ++iteration) {
    const auto weight_of = [&](const Sighting& s, size_t point) {
      const double residual = (measured(s) - colours[point]) / kCauchy;
      return iteration == 0 ? 1 : 1 / (1 + residual * residual);  // at first nothing is known of the colours
    };
    MatrixXd information = kPrior * MatrixXd::Identity(gains.size(), gains.size());
    VectorXd right = VectorXd::Zero(gains.size());
    for (size_t p = 0; p < tracks.size(); ++p) {
      const Track& track = tracks[p];
      weights.clear();
      double sum = 0, mean = 0;
      for (const Sighting& s : track) {
        weights.push_back(weight_of(s, p));
        sum += weights.back();
        mean += weights.back() * s.log_rgb[channel];
      }
      mean /= sum;
      for (size_t i = 0; i < track.size(); ++i) {
        const auto view = Eigen::Index(track[i].view);
        information(view, view) += weights[i];
        right[view] += weights[i] * (track[i].log_rgb[channel] - mean);
        for (size_t j = 0; j < track.size(); ++j) {
          information(view, Eigen::Index(track[j].view)) -= weights[i] * weights[j] / sum;
        }
      }
    }
    gains = information.ldlt().solve(right);
    for (size_t p = 0; p < tracks.size(); ++p) {
      double sum = 0, mean = 0;
      for (const Sighting& s : tracks[p]) {
        const double weight = weight_of(s, p);
        sum += weight;
        mean += weight * measured(s);
      }
      colours[p] = mean / sum;
    }
  }
  return gains;
}

std::vector<Vec3> FromPoints(const std::vector<Track>& tracks, size_t n_views) {
  std::vector<Vec3> log_gains(n_views);
  for (int c = 0; c < 3; ++c) {
    const VectorXd gains = LogGains(tracks, n_views, c);
    for (size_t v = 0; v < n_views; ++v) log_gains[v][size_t(c)] = gains[Eigen::Index(v)];
  }
  return log_gains;
}

// Empty where a training view lacks it.
std::vector<Vec3> FromExif(const std::vector<WrittenExposure>& written, const std::vector<int>& training) {
  std::vector<Vec3> log_gains;
  for (const int view : training) {
    const std::optional<double> ev = written[size_t(view)].Ev();
    if (!ev) return {};
    const double log_gain = *ev * std::log(2.) / kDisplayGamma;
    log_gains.push_back({log_gain, log_gain, log_gain});
  }
  return log_gains;
}

}  // namespace

std::optional<double> WrittenExposure::Ev() const {
  if (!seconds || !f_number || !iso) return {};
  const double light = *seconds * *iso / (*f_number * *f_number);
  if (!(light > 0) || !std::isfinite(light)) return {};
  return std::log2(light);
}

ViewExposures MeasureViewExposures(const ColmapModel& model, const std::map<uint32_t, uint32_t>& view_of_image,
                                   const Scene& scene, const ImagePack& pack,
                                   const std::vector<WrittenExposure>& written) {
  const std::vector<int> training = scene.ViewsOf(Split::kTrain);
  ViewExposures exposures{"none", std::vector<Vec3>(scene.views.size(), Vec3{1, 1, 1})};
  const std::vector<Track> tracks = TrainingTracks(model, view_of_image, scene, pack, training);
  size_t n_sightings = 0;
  for (const Track& track : tracks) n_sightings += track.size();
  std::vector<Vec3> log_gains;
  if (n_sightings >= kFewestSightings * training.size()) {
    log_gains = FromPoints(tracks, training.size());
    exposures.source = "points";
  } else if (log_gains = FromExif(written, training); !log_gains.empty()) {
    exposures.source = "EXIF";
  }
  if (log_gains.empty()) return exposures;
  for (size_t c = 0; c < 3; ++c) {
    double mean = 0;
    for (const Vec3& gain : log_gains) mean += gain[c] / double(log_gains.size());
    for (size_t i = 0; i < training.size(); ++i) {
      exposures.gain[size_t(training[i])][c] = std::exp(log_gains[i][c] - mean);
    }
  }
  return exposures;
}

}  // namespace nrff
