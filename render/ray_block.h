// A few rays traced together by one thread: the samples that light gets to, with their densities and weights.
//
// Rays advance side by side, some samples at a time, so that densities are evaluated in batches and a ray that nothing
// more is seen of stops asking: the samples are those of kernels/sampling.h, cut where the transmittance falls below
// the stop. Their weights are those of kernels/compositing.h, bit by bit; samples behind the stop, whose weight there
// is 0, are missing here.
#pragma once

#include <cstdint>
#include <vector>

#include "render/kernels/ray_marcher.h"
#include "render/kernels/sampling.h"

namespace nrff {

class RadianceField;

class RayBlock {
 public:
  static constexpr int64_t kRays = 64;  // at most

  // Rays first … first + n − 1 of `args`.
  void Trace(const RadianceField& field, const MarchArgs<float>& args, int64_t first, int64_t n,
             float stop_transmittance);

  // Samples of ray r are offsets[r] … offsets[r + 1] − 1, front to back. All valid until the next Trace.
  int64_t n_rays = 0;
  std::vector<int64_t> offsets;  // [n_rays + 1]
  std::vector<float> t, sigma, weights, delta;
  std::vector<float> points;         // [n, 3] field coordinates
  std::vector<float> transmittance;  // [n_rays] behind the last sample
  std::vector<int64_t> n_reached;    // [n_rays]
  int64_t n_evaluated = 0;           // densities, those behind the stop included

  // Samples of weight > threshold, in order: `shaded` are indices into the samples, those of ray r
  // shaded_offsets[r] … shaded_offsets[r + 1] − 1. Of these, those of least weight are left out as long as a ray's
  // weights left out sum to at most `left_out`; unshaded[r] is that sum.
  void Select(float threshold, float left_out = 0);
  std::vector<int64_t> shaded_offsets, shaded;
  std::vector<float> unshaded;  // [n_rays]

 private:
  struct Ray {
    RayMarcher<float> marcher;
    float thickness = 0;
    int64_t n_samples = 0;
    bool ended = false;
  };
  std::vector<Ray> rays_;
  // Of one round, and of all in the order in which they were taken.
  std::vector<int> round_ray_, taken_ray_;
  std::vector<float> ordered_;
  std::vector<float> round_t_, round_points_, round_sigma_, taken_t_, taken_points_, taken_sigma_;
};

}  // namespace nrff
