// Normals, reflection and colour of the networks' tile at normals and views that have no direction to speak of.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <vector>

#include "model/kernels/ree.h"
#include "model/kernels/shading_tile.h"
#include "tests/stability/table.h"
#include "tests/uniforms.h"

namespace nrff::stability {
namespace {

constexpr int kBottleneck = 4, kRowWidth = 4;

// A spatial network that hands its input on, and one layer of weights up to ±1/8 behind the encoding. Weights have so
// few bits that products with them and with such inputs are exact in bf16, too.
struct PlainNetworks {
  PlainNetworks() {
    networks.lobes = MakeLobes(4, 8);
    n_share = networks.lobes.n_theta * kRowWidth;
    n_spatial = 9 + kBottleneck + n_share;
    identity.assign(n_spatial * n_spatial, 0);
    for (int i = 0; i < n_spatial; ++i) identity[i * n_spatial + i] = 1;
    n_directional = kBottleneck + kLobeAmplitudes * networks.lobes.size() + 1;
    directional = Rounded(3 * n_directional, 1. / 8, 1);
    lobe_weights = Rounded(networks.lobes.n_phi * kLobeParameters * kRowWidth, 1, 2);
    zeros.assign(std::max(n_spatial, networks.lobes.n_phi * kLobeParameters), 0);
    networks.spatial = {Layer(n_spatial, n_spatial, identity)};
    networks.lobe_layer = Layer(kRowWidth, networks.lobes.n_phi * kLobeParameters, lobe_weights);
    networks.directional = {Layer(n_directional, 3, directional)};
    networks.bottleneck_width = kBottleneck;
  }

  static std::vector<float> Rounded(int64_t n, double most, uint64_t seed) {
    auto values = Converted<float>(Uniforms(n, -64, 64, seed));
    for (float& value : values) value = std::round(value) * float(most / 64);
    return values;
  }

  LinearLayer Layer(int n_in, int n_out, const std::vector<float>& weight) const {
    return {.n_in = n_in, .n_out = n_out, .weight = weight.data(), .bias = zeros.data()};
  }

  ShadingNetworks networks;
  int n_share = 0, n_spatial = 0, n_directional = 0;
  std::vector<float> identity, directional, lobe_weights, zeros;
};

struct Sample {
  double normal[3], rgb[3];
};

// The same in double. x: what the spatial network says.
Sample Exact(const PlainNetworks& plain, const std::vector<double>& x, const double* direction) {
  const Lobes& lobes = plain.networks.lobes;
  const double norm = std::hypot(x[6], x[7], x[8]);
  Sample sample;
  double cosine = 0, reflected[3];
  for (int k = 0; k < 3; ++k) sample.normal[k] = -x[6 + k] / std::max(norm, 1e-12);
  for (int k = 0; k < 3; ++k) cosine -= direction[k] * sample.normal[k];
  for (int k = 0; k < 3; ++k) reflected[k] = 2 * cosine * sample.normal[k] + direction[k];
  const int per_row = lobes.n_phi * kLobeParameters;
  std::vector<double> raw(lobes.n_theta * per_row, 0), in(x.begin() + 9, x.begin() + 9 + kBottleneck);
  for (int i = 0; i < lobes.n_theta * per_row; ++i) {
    for (int k = 0; k < kRowWidth; ++k) {
      raw[i] += plain.lobe_weights[i % per_row * kRowWidth + k] * x[9 + kBottleneck + i / per_row * kRowWidth + k];
    }
  }
  in.resize(plain.n_directional);
  ReeForward(lobes, reflected, raw.data(), 1, in.data() + kBottleneck);
  in.back() = cosine;
  for (int c = 0; c < 3; ++c) {
    double specular = 0;
    for (int i = 0; i < plain.n_directional; ++i) specular += plain.directional[c * plain.n_directional + i] * in[i];
    sample.rgb[c] = 1 / (1 + std::exp(-x[c] - x[3 + c] * specular));
  }
  return sample;
}

// Normals of length 0, denormal, below and above the least length that is divided by, and large, each seen from in
// front, from behind and at grazing angles. A normal is off by 6u. With |raw lobe parameters| ≤ 4, λ and μ are
// below 3.1 and an amplitude below 4: an encoding's 16 + 12√λ roundings (FloatIsDoubleForAnyLobe) and the reflection's
// 16, through a slope of at most 4(1 + 2√λ), come to 4 · (38 + 16 · 4.6)u; weights are up to 1/8, the sum of 69 terms
// up to 4/8 has 69 roundings, |tint| ≤ 1, and a sigmoid's slope is ¼.
TEST(Shading, NormalsWithoutADirectionAndAllViewsOfThem) {
  const PlainNetworks plain;
  ShadingTile tile(plain.networks, /*backward=*/true);
  const std::vector<int> exponents = {-200, -140, -100, -46, -38, -10, 0, 20, 50};
  const double turns[][3] = {{1, 0, 0}, {-1, 0, 0}, {0, 1, 0}, {0, 0, 1}, {0.6, 0.8, 0}, {0.6, 0, -0.8}};
  const double sides[][3] = {{4, 0, 0}, {0, 0, -2}, {3, -4, 12}};
  std::vector<std::vector<double>> inputs, directions;
  for (const int exponent : exponents) {
    for (const auto& side : sides) {
      for (const auto& turn : turns) {
        auto x = PlainNetworks::Rounded(plain.n_spatial, 1, inputs.size());
        for (int k = 0; k < 3; ++k) x[6 + k] = std::ldexp(float(side[k]), exponent);
        inputs.emplace_back(x.begin(), x.end());
        directions.push_back({float(turn[0]), float(turn[1]), float(turn[2])});
      }
    }
  }
  const auto n = int64_t(inputs.size());
  tile.Reserve(n);
  std::fill_n(tile.features(), plain.n_spatial * tile.stride(), 0.F);
  for (int64_t s = 0; s < n; ++s) {
    for (int r = 0; r < plain.n_spatial; ++r) tile.features()[r * tile.stride() + s] = float(inputs[s][r]);
    for (int k = 0; k < 3; ++k) tile.ray_directions()[k * tile.stride() + s] = float(directions[s][k]);
  }
  tile.Forward(plain.networks, n);
  Worst normals, colours;
  for (int64_t s = 0; s < n; ++s) {
    const Sample exact = Exact(plain, inputs[s], directions[s].data());
    for (int k = 0; k < 3; ++k) {
      normals.Add(std::abs(tile.normals()[k * tile.stride() + s] - exact.normal[k]), 6 * kUnit<float>);
      const double encodings = plain.n_directional * 4 * (38 + 16 * 4.6) / 8, sum = 69 * plain.n_directional * 0.5;
      colours.Add(std::abs(tile.rgb()[k * tile.stride() + s] - exact.rgb[k]),
                  (0.25 * (encodings + sum) + 4) * kUnit<float>);
    }
  }
  normals.Hold("shading", "normals of length 0, denormal, 1e-30 to 1e15", "float against double");
  colours.Hold("shading", "colour, views from in front, behind, grazing", "float against double");

  ShadingGradients gradients(plain.networks);
  for (int row = 0; row < 3; ++row) {
    std::fill_n(tile.d_rgb() + row * tile.stride(), n, 1.F);
    std::fill_n(tile.d_normals() + row * tile.stride(), n, 1.F);
  }
  tile.Backward(plain.networks, n, gradients);
  int64_t n_beyond = 0;
  for (int row = 0; row < plain.n_spatial; ++row) {
    for (int64_t s = 0; s < n; ++s) n_beyond += std::isfinite(tile.d_features()[row * tile.stride() + s]) ? 0 : 1;
  }
  Hold("shading", "gradients that are not finite", "the same normals and views", double(n_beyond), 0);
}

}  // namespace
}  // namespace nrff::stability
