#include "model/directional_encoding.h"

#include <ATen/ATen.h>

#include <array>
#include <utility>
#include <vector>

#include "model/kernels/directional_encoding.h"

namespace nrff {

using torch::Tensor;

Tensor IdeEncode(const Tensor& directions, const Tensor& raw) {
  constexpr int kHighest = kIdeDegrees.back();
  const Tensor x = directions.select(1, 0), y = directions.select(1, 1), z = directions.select(1, 2);
  const Tensor roughness = at::softplus(raw.select(1, 0) - 1);
  std::array<std::vector<Tensor>, kHighest + 1> of_degree;
  Tensor real = at::ones_like(x), imaginary = at::zeros_like(x);  // of (x + iy)^m
  for (int m = 0; m <= kHighest; ++m) {
    const HarmonicRecurrence recurrence = MakeHarmonicRecurrence(m);
    Tensor before = at::zeros_like(z), last = at::full_like(z, recurrence.start);
    for (int l = m; l <= kHighest; ++l) {
      if (l > m) {
        before = std::exchange(last, z * last * recurrence.up[l] - before * recurrence.back[l]);
      }
      of_degree[l].push_back(last * real);
      of_degree[l].push_back(last * imaginary);
    }
    const Tensor next = real * x - imaginary * y;
    imaginary = real * y + imaginary * x;
    real = next;
  }
  std::vector<Tensor> features;
  for (const int l : kIdeDegrees) {
    const Tensor attenuation = at::exp(roughness * (-0.5 * l * (l + 1)));
    for (const Tensor& harmonic : of_degree[l]) features.push_back(harmonic * attenuation);
  }
  return at::stack(features, 1);
}

Tensor PeEncode(const Tensor& ray_directions) {
  std::vector<Tensor> features{ray_directions};
  for (int k = 0; k < kPeFrequencies; ++k) {
    const Tensor angles = ray_directions * double(1 << k);
    features.push_back(angles.sin());
    features.push_back(angles.cos());
  }
  return at::cat(features, 1);
}

}  // namespace nrff
