#include "render/ray_block.h"

#include <algorithm>
#include <cmath>

#include "render/kernels/compositing.h"
#include "render/kernels/compositing_ray.h"
#include "render/radiance_field.h"

namespace nrff {
namespace {

constexpr int kFewestPerRay = 2;       // samples of a ray in a round
constexpr int kSamplesPerRound = 128;  // about what the field's kernels work on at once

}  // namespace

void RayBlock::Trace(const RadianceField& field, const MarchArgs<float>& args, int64_t first, int64_t n,
                     float stop_transmittance) {
  n_rays = n;
  n_evaluated = 0;
  rays_.resize(n);
  for (int64_t r = 0; r < n; ++r) rays_[r] = {RayMarcher<float>(args, first + r), 0, 0, false};
  taken_ray_.clear();
  taken_t_.clear();
  taken_points_.clear();
  taken_sigma_.clear();
  const auto step = static_cast<float>(args.step);
  const float most_thickness = -std::log(stop_transmittance);  // infinite for 0
  int64_t n_alive = n;
  while (n_alive > 0) {
    const int per_ray = std::max<int>(kFewestPerRay, kSamplesPerRound / static_cast<int>(n_alive));
    round_ray_.clear();
    round_t_.clear();
    round_points_.clear();
    for (int64_t r = 0; r < n; ++r) {
      if (rays_[r].ended) continue;
      float t, point[3];
      for (int k = 0; k < per_ray; ++k) {
        if (!rays_[r].marcher.Next(t, point)) {
          rays_[r].ended = true;
          --n_alive;
          break;
        }
        round_ray_.push_back(static_cast<int>(r));
        round_t_.push_back(t);
        round_points_.insert(round_points_.end(), point, point + 3);
      }
    }
    const size_t n_round = round_ray_.size();
    if (n_round == 0) break;
    round_sigma_.resize(n_round);
    field.DensityOf(round_points_.data(), static_cast<int64_t>(n_round), round_sigma_.data());
    n_evaluated += static_cast<int64_t>(n_round);
    for (size_t i = 0; i < n_round; ++i) {
      Ray& ray = rays_[round_ray_[i]];
      if (ray.thickness > most_thickness) continue;  // ended earlier in this round
      ray.thickness += round_sigma_[i] * step;
      ++ray.n_samples;
      taken_ray_.push_back(round_ray_[i]);
      taken_t_.push_back(round_t_[i]);
      taken_points_.insert(taken_points_.end(), &round_points_[3 * i], &round_points_[3 * i] + 3);
      taken_sigma_.push_back(round_sigma_[i]);
      if (ray.thickness > most_thickness && !ray.ended) {
        ray.ended = true;
        --n_alive;
      }
    }
  }

  offsets.resize(n + 1);
  offsets[0] = 0;
  for (int64_t r = 0; r < n; ++r) offsets[r + 1] = offsets[r] + rays_[r].n_samples;
  const int64_t n_samples = offsets[n];
  t.resize(n_samples);
  sigma.resize(n_samples);
  weights.resize(n_samples);
  points.resize(3 * n_samples);
  delta.assign(n_samples, step);
  for (int64_t r = 0; r < n; ++r) rays_[r].n_samples = offsets[r];  // now: where the ray's next sample goes
  for (size_t i = 0; i < taken_ray_.size(); ++i) {
    const int64_t at = rays_[taken_ray_[i]].n_samples++;
    t[at] = taken_t_[i];
    sigma[at] = taken_sigma_[i];
    std::copy_n(&taken_points_[3 * i], 3, &points[3 * at]);
  }
  transmittance.resize(n);
  n_reached.resize(n);
  const WeightsArgs<float> weights_args{.n_rays = n,
                                        .ray_offsets = offsets.data(),
                                        .sigma = sigma.data(),
                                        .delta = delta.data(),
                                        .stop_transmittance = stop_transmittance,
                                        .weights = weights.data(),
                                        .transmittance = transmittance.data(),
                                        .n_reached = n_reached.data()};
  for (int64_t r = 0; r < n; ++r) WeightsForwardRay(weights_args, r);
}

void RayBlock::Select(float threshold, float left_out) {
  shaded_offsets.resize(n_rays + 1);
  shaded_offsets[0] = 0;
  shaded.clear();
  unshaded.assign(n_rays, 0.F);
  for (int64_t r = 0; r < n_rays; ++r) {
    float least = threshold;
    if (left_out > 0) {
      ordered_.clear();
      for (int64_t i = offsets[r]; i < offsets[r + 1]; ++i) {
        if (weights[i] > threshold) ordered_.push_back(weights[i]);
      }
      std::sort(ordered_.begin(), ordered_.end());
      float sum = 0;
      for (size_t i = 0; i < ordered_.size(); ++i) {
        sum += ordered_[i];
        if (sum > left_out) break;
        if (i + 1 < ordered_.size() && ordered_[i + 1] == ordered_[i]) continue;  // equal ones go together
        least = ordered_[i];
        unshaded[r] = sum;
      }
    }
    for (int64_t i = offsets[r]; i < offsets[r + 1]; ++i) {
      if (weights[i] > least) shaded.push_back(i);
    }
    shaded_offsets[r + 1] = static_cast<int64_t>(shaded.size());
  }
}

}  // namespace nrff
