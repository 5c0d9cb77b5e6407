// A radiance field with closed forms: a Gaussian ball of smooth colour, radial normals.
#pragma once

#include <ATen/ATen.h>

#include <atomic>
#include <cstdint>
#include <limits>

#include "render/radiance_field.h"

namespace nrff {

// σ(x) = amplitude·exp(−|x|²/(2 width²)); c(x) = ½ + ½ sin(frequency·x + phase per channel); n = x/|x|.
class GaussianBall : public RadianceField {
 public:
  torch::Tensor amplitude, width, frequency;  // scalars; their type is the field's
  mutable std::atomic<int64_t> n_density = 0, n_shade = 0;  // points; rendering asks from several threads

  explicit GaussianBall(torch::Dtype type, double amplitude_value = 8)
      : amplitude(at::full({}, amplitude_value, type)),
        width(at::full({}, 0.25, type)),
        frequency(at::full({}, 3., type)) {}

  torch::Tensor Density(const torch::Tensor& points_any) const override {
    const torch::Tensor points = points_any.to(amplitude.scalar_type());
    n_density += points.size(0);
    Note(points.size(0));
    return amplitude * at::exp(-points.square().sum(1) / (2 * width.square()));
  }
  Shading Shade(const torch::Tensor& points, const torch::Tensor& ray_directions) const override {
    n_shade += ray_directions.size(0);
    Note(points.size(0));
    const torch::Tensor phase = at::arange(3, points.options());
    return {0.5 + 0.5 * at::sin(frequency * points + phase), points / points.norm(2, 1, true)};
  }

  mutable std::atomic<int64_t> smallest_call = std::numeric_limits<int64_t>::max();  // points

 private:
  void Note(int64_t n) const {
    int64_t smallest = smallest_call;
    while (n < smallest && !smallest_call.compare_exchange_weak(smallest, n)) {
    }
  }
};

}  // namespace nrff
