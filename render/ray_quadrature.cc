#include "render/ray_quadrature.h"

#include <algorithm>
#include <cmath>

namespace nrff {
namespace {

constexpr float kPairWeight = 30;      // in tolerances: neighbours of less together are one sample, for good
constexpr float kFirstWeight = 0.25F;  // of a span at first
constexpr int64_t kMostSamples = 16;   // in a span
constexpr float kGap = 3.5F;           // steps: samples farther apart lie on different surfaces
// Neighbours' colours differ by slope more than by curvature: the estimate lies so far above the error.
constexpr float kCaution = 4;

}  // namespace

void RayQuadrature::Integrate(const RayBlock& block, const float* directions, double step, float tolerance,
                              RadianceField::Shader& shader) {
  Gather(block, static_cast<float>(step), tolerance);
  const size_t n = weights_.size();
  n_shaded = 0;
  Start(static_cast<float>(step), tolerance);
  if (n > 0) {
    shader.SetSamples(points_.data(), weights_.data(), static_cast<int64_t>(n));
    do {
      ShadeNew(directions, shader);
    } while (tolerance > 0 && Split(tolerance));
  }
  rgb.assign(3 * block.n_rays, 0.F);
  normals.assign(3 * block.n_rays, 0.F);
  for (const RaySpan& span : spans_) {
    for (int c = 0; c < 3; ++c) {
      rgb[3 * span.ray + c] += span.weight * span.rgb[c];
      normals[3 * span.ray + c] += span.weight * span.normal[c];
    }
  }
}

void RayQuadrature::Gather(const RayBlock& block, float step, float tolerance) {
  points_.clear();
  weights_.clear();
  t_.clear();
  offsets_.assign(1, 0);
  for (int64_t r = 0; r < block.n_rays; ++r) {
    bool single = false;  // whether the last sample may get a second
    float last_t = 0;
    for (int64_t i = block.shaded_offsets[r]; i < block.shaded_offsets[r + 1]; ++i) {
      const int64_t sample = block.shaded[i];
      const float weight = block.weights[sample], t = block.t[sample];
      const float* point = &block.points[3 * sample];
      single = single && t - last_t < 1.5F * step && weights_.back() + weight < kPairWeight * tolerance;
      last_t = t;
      if (single) {
        weights_.back() += weight;
        const float share = weight / weights_.back();
        t_.back() += share * (t - t_.back());
        float* mean = &points_[points_.size() - 3];
        for (int k = 0; k < 3; ++k) mean[k] += share * (point[k] - mean[k]);
        single = false;
      } else {
        points_.insert(points_.end(), point, point + 3);
        weights_.push_back(weight);
        t_.push_back(t);
        single = tolerance > 0;
      }
    }
    offsets_.push_back(static_cast<int64_t>(weights_.size()));
  }
}

void RayQuadrature::Start(float step, float tolerance) {
  spans_.clear();
  for (size_t r = 0; r + 1 < offsets_.size(); ++r) {
    int64_t first = offsets_[r];
    const int64_t end = offsets_[r + 1];
    float weight = 0;
    for (int64_t i = first; i < end; ++i) {
      const bool full = tolerance == 0 || i - first >= kMostSamples || weight + 0.5F * weights_[i] > kFirstWeight;
      if (i > first && (full || t_[i] - t_[i - 1] > kGap * step)) {
        AddSpan(static_cast<int64_t>(r), first, i);
        first = i;
        weight = 0;
      }
      weight += weights_[i];
    }
    if (end > first) AddSpan(static_cast<int64_t>(r), first, end);
  }
}

void RayQuadrature::AddSpan(int64_t ray, int64_t begin, int64_t end) {
  RaySpan span{.ray = ray,
               .samples = {begin, end},
               .weight = 0,
               .t = 0,
               .variance = 0,
               .shaded = false,
               .rgb = {},
               .normal = {}};
  for (int64_t i = begin; i < end; ++i) {
    span.weight += weights_[i];
    span.t += weights_[i] * (t_[i] - t_[begin]);
  }
  span.t = t_[begin] + span.t / span.weight;
  for (int64_t i = begin; i < end; ++i) span.variance += weights_[i] * (t_[i] - span.t) * (t_[i] - span.t);
  span.variance /= span.weight;
  spans_.push_back(span);
}

void RayQuadrature::ShadeNew(const float* directions, RadianceField::Shader& shader) {
  new_.clear();
  new_samples_.clear();
  new_directions_.clear();
  for (size_t s = 0; s < spans_.size(); ++s) {
    if (spans_[s].shaded) continue;
    const float* direction = directions + 3 * spans_[s].ray;
    new_.push_back(s);
    new_samples_.push_back(spans_[s].samples);
    new_directions_.insert(new_directions_.end(), direction, direction + 3);
  }
  const auto n = static_cast<int64_t>(new_.size());
  n_shaded += n;
  new_rgb_.resize(3 * n);
  new_normals_.resize(3 * n);
  shader.Shade(new_samples_.data(), new_directions_.data(), n, new_rgb_.data(), new_normals_.data());
  for (int64_t k = 0; k < n; ++k) {
    RaySpan& span = spans_[new_[k]];
    std::copy_n(&new_rgb_[3 * k], 3, span.rgb);
    std::copy_n(&new_normals_[3 * k], 3, span.normal);
    span.shaded = true;
  }
}

bool RayQuadrature::Split(float tolerance) {
  split_.clear();
  for (size_t s = 0; s < spans_.size(); ++s) {
    split_.push_back(spans_[s]);
    split_.back().shaded =
        spans_[s].samples.end - spans_[s].samples.begin == 1 || ErrorEstimate(s) <= kCaution * tolerance;
  }
  const auto whole = [](const RaySpan& span) { return span.shaded; };
  if (std::all_of(split_.begin(), split_.end(), whole)) return false;
  spans_.clear();
  for (const RaySpan& span : split_) {
    if (whole(span)) {
      spans_.push_back(span);
      continue;
    }
    const auto [begin, end] = span.samples;
    int64_t middle = begin + 1;
    for (float weight = weights_[begin]; middle < end - 1 && weight + 0.5F * weights_[middle] < 0.5F * span.weight;
         ++middle) {
      weight += weights_[middle];
    }
    AddSpan(span.ray, begin, middle);
    AddSpan(span.ray, middle, end);
  }
  return true;
}

// ½ c'' w Var(t), with the largest c'' that the difference to a neighbour's colour leaves room for.
float RayQuadrature::ErrorEstimate(size_t s) const {
  const RaySpan& span = spans_[s];
  float curvature = 0;
  const auto compare = [&](const RaySpan& other) {
    if (other.ray != span.ray) return;
    float difference = 0;
    for (int c = 0; c < 3; ++c) difference = std::max(difference, std::abs(span.rgb[c] - other.rgb[c]));
    curvature = std::max(curvature, difference / ((span.t - other.t) * (span.t - other.t)));
  };
  if (s > 0) compare(spans_[s - 1]);
  if (s + 1 < spans_.size()) compare(spans_[s + 1]);
  return 0.5F * curvature * span.weight * span.variance;
}

}  // namespace nrff
