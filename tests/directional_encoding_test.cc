// Laws of the directional encodings that NRFF is compared with: closed forms, sums over orders, derivatives.

#include "model/kernels/directional_encoding.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <numbers>
#include <string>
#include <vector>

#include "tests/uniforms.h"

namespace nrff {
namespace {

constexpr int64_t kSamples = 64, kStride = kSamples + 5;

// Directions in rows: the poles, the axes, then at random.
std::vector<float> Directions() {
  const std::vector<std::vector<double>> fixed = {{0, 0, 1}, {0, 0, -1}, {1, 0, 0}, {0, -1, 0}, {0.6, 0, 0.8}};
  const std::vector<double> random = Uniforms(3 * kSamples, -1, 1, 11);
  std::vector<float> rows(3 * kStride);
  for (int64_t s = 0; s < kSamples; ++s) {
    double d[3], square = 0;
    for (int k = 0; k < 3; ++k) {
      d[k] = s < int64_t(fixed.size()) ? fixed[s][k] : random[3 * s + k];
      square += d[k] * d[k];
    }
    for (int k = 0; k < 3; ++k) rows[k * kStride + s] = float(d[k] / std::sqrt(square));
  }
  return rows;
}

std::vector<float> RawRoughness() {
  const std::vector<double> values = Uniforms(kSamples, -6, 0, 12);
  return {values.begin(), values.end()};
}

double Softplus(double x) { return std::log1p(std::exp(x)); }

// The encoding at (x, y, z) as a polynomial in them, from the standard library's spherical harmonics.
std::vector<double> Expected(double x, double y, double z, double raw) {
  std::vector<double> features;
  const double theta = std::acos(std::clamp(z, -1., 1.)), sine = std::sin(theta);
  const double radius = std::hypot(x, y), phi = std::atan2(y, x), roughness = Softplus(raw - 1);
  for (const int l : kIdeDegrees) {
    for (int m = 0; m <= l; ++m) {
      const double without_phase = (m % 2 == 0 ? 1 : -1) * std::sph_legendre(l, m, theta);
      const double along = m == 0 ? 1 : sine < 1e-6 ? 0 : std::pow(radius / sine, m);
      const double size = std::exp(-0.5 * l * (l + 1) * roughness) * without_phase * along;
      features.push_back(size * std::cos(m * phi));
      features.push_back(size * std::sin(m * phi));
    }
  }
  return features;
}

TEST(Ide, IsTheStandardLibrarysHarmonicsAttenuated) {
  const std::vector<float> o = Directions(), raw = RawRoughness();
  std::vector<float> encoding(kIdeFeatures * kStride);
  IdeForwardRows(o.data(), raw.data(), kSamples, kStride, encoding.data());
  for (int64_t s = 0; s < kSamples; ++s) {
    const auto expected = Expected(o[s], o[kStride + s], o[2 * kStride + s], raw[s]);
    ASSERT_EQ(expected.size(), kIdeFeatures);
    // Sixteen steps of the recurrence, each rounded; the attenuation's exponent is up to 136 times a rounded number.
    for (int f = 0; f < kIdeFeatures; ++f) EXPECT_NEAR(encoding[f * kStride + s], expected[f], 2e-5) << s << " " << f;
  }
}

// Unsöld: over all orders, |Y_lm|² sums to (2l + 1)/4π in every direction.
TEST(Ide, SmoothSurfacesKeepADegreesWhole) {
  const std::vector<float> o = Directions(), raw(kSamples, -40.F);
  std::vector<float> encoding(kIdeFeatures * kStride);
  IdeForwardRows(o.data(), raw.data(), kSamples, kStride, encoding.data());
  for (int64_t s = 0; s < kSamples; ++s) {
    const float* row = encoding.data() + s;
    for (const int l : kIdeDegrees) {
      double sum = 0;
      for (int m = 0; m <= l; ++m, row += 2 * kStride) {
        sum += (m == 0 ? 1 : 2) * (double(row[0]) * row[0] + double(row[kStride]) * row[kStride]);
      }
      EXPECT_NEAR(sum * 4 * std::numbers::pi / (2 * l + 1), 1, 1e-5) << s << " " << l;
    }
  }
}

TEST(Ide, GradientsAgreeWithDifferences) {
  const std::vector<float> o = Directions(), raw = RawRoughness();
  const std::vector<double> upstream = Uniforms(kIdeFeatures * kStride, -1, 1, 13);
  const std::vector<float> d_encoding(upstream.begin(), upstream.end());
  std::vector<float> d_o(3 * kStride), d_raw(kStride);
  IdeBackwardRows(o.data(), raw.data(), d_encoding.data(), kSamples, kStride, d_o.data(), d_raw.data());
  constexpr double kStep = 1e-5;
  for (int64_t s = 5; s < kSamples; ++s) {  // at the poles and axes the expected form has no derivative
    for (int k = 0; k < 4; ++k) {
      double at[2][4], value[2] = {};
      for (int side = 0; side < 2; ++side) {
        for (int i = 0; i < 4; ++i) at[side][i] = i < 3 ? o[i * kStride + s] : raw[s];
        at[side][k] += side == 0 ? -kStep : kStep;
        const auto features = Expected(at[side][0], at[side][1], at[side][2], at[side][3]);
        for (int f = 0; f < kIdeFeatures; ++f) value[side] += d_encoding[f * kStride + s] * features[f];
      }
      const double expected = (value[1] - value[0]) / (2 * kStep);
      const double actual = k < 3 ? d_o[k * kStride + s] : d_raw[s];
      EXPECT_NEAR(actual, expected, 2e-4 * (1 + std::abs(expected))) << s << " " << k;
    }
  }
}

TEST(Ide, StaysFiniteAtExtremes) {
  const std::vector<float> o = Directions();
  std::vector<float> raw(kSamples);
  for (int64_t s = 0; s < kSamples; ++s) raw[s] = (s % 2 == 0 ? 1.F : -1.F) * std::pow(10.F, float(s % 8));
  std::vector<float> encoding(kIdeFeatures * kStride), d_o(3 * kStride), d_raw(kStride);
  const std::vector<float> d_encoding(kIdeFeatures * kStride, 1.F);
  IdeForwardRows(o.data(), raw.data(), kSamples, kStride, encoding.data());
  IdeBackwardRows(o.data(), raw.data(), d_encoding.data(), kSamples, kStride, d_o.data(), d_raw.data());
  for (const auto* values : {&encoding, &d_o, &d_raw}) {
    for (const float value : *values) EXPECT_TRUE(std::isfinite(value));
  }
}

TEST(PositionalEncoding, IsSinesAndCosines) {
  const std::vector<float> d = Directions();
  std::vector<float> encoding(kPeFeatures * kStride);
  PeForwardRows(d.data(), kSamples, kStride, encoding.data());
  for (int64_t s = 0; s < kSamples; ++s) {
    for (int axis = 0; axis < 3; ++axis) {
      const double x = d[axis * kStride + s];
      EXPECT_EQ(encoding[axis * kStride + s], float(x));
      for (int k = 0; k < kPeFrequencies; ++k) {
        EXPECT_NEAR(encoding[(3 + 6 * k + axis) * kStride + s], std::sin(std::ldexp(x, k)), 2e-6);
        EXPECT_NEAR(encoding[(6 + 6 * k + axis) * kStride + s], std::cos(std::ldexp(x, k)), 2e-6);
      }
    }
  }
}

}  // namespace
}  // namespace nrff
