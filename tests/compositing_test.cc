// Compositing kernels against closed forms, finite differences and long double. No torch.

#include "render/kernels/compositing.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>
#include <vector>

namespace nrff {
namespace {

template <typename Scalar>
struct Weighted {
  std::vector<Scalar> weights, transmittance;
  std::vector<int64_t> n_reached;
};

template <typename Scalar>
Weighted<Scalar> Weigh(const std::vector<int64_t>& offsets, const std::vector<Scalar>& sigma,
                       const std::vector<Scalar>& delta, double stop = 0) {
  const size_t n_rays = offsets.size() - 1;
  Weighted<Scalar> out{std::vector<Scalar>(sigma.size(), -1), std::vector<Scalar>(n_rays, -1),
                       std::vector<int64_t>(n_rays, -1)};
  WeightsForwardCpu(WeightsArgs<Scalar>{static_cast<int64_t>(n_rays), offsets.data(), sigma.data(), delta.data(),
                                        static_cast<Scalar>(stop), out.weights.data(), out.transmittance.data(),
                                        out.n_reached.data()});
  return out;
}

template <typename Scalar>
std::vector<Scalar> WeighBackward(const std::vector<int64_t>& offsets, const std::vector<Scalar>& delta,
                                  const Weighted<Scalar>& forward, const std::vector<Scalar>& dL_dweights,
                                  const std::vector<Scalar>& dL_dtransmittance) {
  std::vector<Scalar> dL_dsigma(delta.size(), std::numeric_limits<Scalar>::quiet_NaN());
  WeightsBackwardCpu(WeightsBackwardArgs<Scalar>{static_cast<int64_t>(offsets.size()) - 1, offsets.data(), delta.data(),
                                                 forward.weights.data(), forward.transmittance.data(),
                                                 forward.n_reached.data(), dL_dweights.data(), dL_dtransmittance.data(),
                                                 dL_dsigma.data()});
  return dL_dsigma;
}

template <typename Scalar>
struct RandomSamples {
  std::vector<int64_t> offsets{0};
  std::vector<Scalar> sigma, delta;
};

// Rays of 0 … 60 samples whose optical thickness spans [1e-12, 10^max_exponent].
template <typename Scalar>
RandomSamples<Scalar> MakeSamples(int n_rays, double max_exponent, unsigned seed) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<double> exponent(-12, max_exponent), length(1e-3, 1e-1);
  RandomSamples<Scalar> samples;
  for (int r = 0; r < n_rays; ++r) {
    const int n = r % 61;
    for (int i = 0; i < n; ++i) {
      samples.delta.push_back(static_cast<Scalar>(length(random)));
      samples.sigma.push_back(static_cast<Scalar>(std::pow(10, exponent(random))) / samples.delta.back());
    }
    samples.offsets.push_back(samples.offsets.back() + n);
  }
  return samples;
}

template <typename Scalar>
class CompositingTest : public testing::Test {};
using Scalars = testing::Types<float, double>;
TYPED_TEST_SUITE(CompositingTest, Scalars);

TYPED_TEST(CompositingTest, WeightsAndTransmittanceSumToOneForAnyThickness) {
  for (const double stop : {0., 1e-4, 0.3}) {
    const auto samples = MakeSamples<TypeParam>(2000, 12, 1);
    const auto out = Weigh(samples.offsets, samples.sigma, samples.delta, stop);
    for (size_t r = 0; r + 1 < samples.offsets.size(); ++r) {
      double sum = out.transmittance[r];
      for (int64_t i = samples.offsets[r]; i < samples.offsets[r + 1]; ++i) {
        ASSERT_GE(out.weights[i], 0);
        sum += out.weights[i];
      }
      // Per sample: rounding of Σ τ moves T by at most ε·S·e^−S ≤ ε/e, and w and T are each rounded.
      const double n = static_cast<double>(samples.offsets[r + 1] - samples.offsets[r]) + 1;
      ASSERT_NEAR(sum, 1, 3 * n * std::numeric_limits<TypeParam>::epsilon());
    }
  }
}

TYPED_TEST(CompositingTest, HomogeneousMediumFollowsBeerAndLambert) {
  constexpr int kSamples = 128;
  const std::vector<int64_t> offsets{0, kSamples};
  for (const double thickness : {1e-9, 1e-3, 1., 20.}) {
    const std::vector<TypeParam> sigma(kSamples, static_cast<TypeParam>(thickness / 2)), delta(kSamples, 2. / kSamples);
    const auto out = Weigh(offsets, sigma, delta);
    const double expected = std::exp(-thickness);
    const double relative = kSamples * (1 + thickness) * std::numeric_limits<TypeParam>::epsilon();
    EXPECT_NEAR(out.transmittance[0], expected, expected * relative);
    double opacity = 0;
    for (const TypeParam w : out.weights) opacity += w;
    EXPECT_NEAR(opacity, -std::expm1(-thickness), -std::expm1(-thickness) * relative);
  }
}

TYPED_TEST(CompositingTest, LinearDensityAtMidpointsIsExact) {
  constexpr int kSamples = 64;
  const double a = 0.3, b = 1.7, length = 1.5, step = length / kSamples;
  std::vector<TypeParam> sigma, delta(kSamples, static_cast<TypeParam>(step));
  for (int i = 0; i < kSamples; ++i) sigma.push_back(static_cast<TypeParam>(a + b * (i + 0.5) * step));
  const auto out = Weigh({0, kSamples}, sigma, delta);
  const double expected = std::exp(-a * length - 0.5 * b * length * length);
  EXPECT_NEAR(out.transmittance[0], expected, expected * 4 * kSamples * std::numeric_limits<TypeParam>::epsilon());
}

TYPED_TEST(CompositingTest, ThinSamplesKeepTheirRelativePrecision) {
  for (const double tau : {1e-12, 1e-8, 1.1e-5, 4.5e-5}) {
    const auto out = Weigh<TypeParam>({0, 1}, {static_cast<TypeParam>(tau)}, {TypeParam(1)});
    EXPECT_NEAR(out.weights[0] / -std::expm1(-tau), 1, 4 * std::numeric_limits<TypeParam>::epsilon()) << tau;
  }
}

// A product of (1 − α) would never leave 1 here in float: 1 − 2⁻²⁷ rounds to it.
TYPED_TEST(CompositingTest, ManySamplesTooThinToShowAloneAddUp) {
  constexpr int kSamples = 1 << 20;
  const std::vector<TypeParam> tau(kSamples, static_cast<TypeParam>(0x1p-27)), one(kSamples, 1);
  EXPECT_NEAR(Weigh({0, kSamples}, tau, one).transmittance[0], std::exp(-0x1p-7),
              std::numeric_limits<TypeParam>::epsilon());
}

// Lengths by k and densities by 1/k describe the same scene.
TYPED_TEST(CompositingTest, RescalingTheSceneByPowersOfTwoChangesNoBit) {
  const auto samples = MakeSamples<TypeParam>(200, 2, 2);
  const auto original = Weigh(samples.offsets, samples.sigma, samples.delta, 1e-4);
  for (const int exponent : {-20, 20}) {
    auto scaled = samples;
    for (TypeParam& s : scaled.sigma) s = std::ldexp(s, -exponent);
    for (TypeParam& d : scaled.delta) d = std::ldexp(d, exponent);
    const auto out = Weigh(scaled.offsets, scaled.sigma, scaled.delta, 1e-4);
    EXPECT_EQ(out.weights, original.weights);
    EXPECT_EQ(out.transmittance, original.transmittance);
  }
}

TYPED_TEST(CompositingTest, NothingBehindTheStopHasWeightOrGradientAndNoWeightAboveItIsLost) {
  constexpr double kStop = 1e-3;
  const auto samples = MakeSamples<TypeParam>(500, 1, 3);
  const auto full = Weigh(samples.offsets, samples.sigma, samples.delta);
  const auto stopped = Weigh(samples.offsets, samples.sigma, samples.delta, kStop);
  const auto gradient =
      WeighBackward(samples.offsets, samples.delta, stopped, std::vector<TypeParam>(samples.sigma.size(), 1),
                    std::vector<TypeParam>(stopped.transmittance.size(), 0));
  int n_stopped = 0;
  for (size_t r = 0; r + 1 < samples.offsets.size(); ++r) {
    for (int64_t i = samples.offsets[r]; i < samples.offsets[r + 1]; ++i) {
      if (i < samples.offsets[r] + stopped.n_reached[r]) {
        ASSERT_EQ(stopped.weights[i], full.weights[i]);
      } else {
        ++n_stopped;
        ASSERT_EQ(stopped.weights[i], 0);
        ASSERT_EQ(gradient[i], 0);
        ASSERT_LE(full.weights[i], kStop);
        ASSERT_LT(stopped.transmittance[r], kStop);
      }
    }
  }
  EXPECT_GT(n_stopped, 100);
}

// C = Σ w c + T_end·bg  ⇒  ∂C/∂σ_i = δ_i (T_{i+1} c_i − Σ_{j>i} w_j c_j − T_end·bg), here with T and w from products
// of exponentials in long double.
TYPED_TEST(CompositingTest, GradientMatchesTheClosedFormFromThinToThick) {
  const double background = 0.7;
  for (const double max_exponent : {0., 12.}) {
    const auto samples = MakeSamples<TypeParam>(300, max_exponent, 4);
    std::mt19937 random(5);
    std::uniform_real_distribution<double> uniform(0, 1);
    std::vector<TypeParam> color(samples.sigma.size());
    for (TypeParam& c : color) c = static_cast<TypeParam>(uniform(random));
    const auto forward = Weigh(samples.offsets, samples.sigma, samples.delta);
    const auto gradient =
        WeighBackward(samples.offsets, samples.delta, forward, color,
                      std::vector<TypeParam>(forward.transmittance.size(), static_cast<TypeParam>(background)));
    for (size_t r = 0; r + 1 < samples.offsets.size(); ++r) {
      const int64_t begin = samples.offsets[r], end = samples.offsets[r + 1];
      std::vector<long double> transmittance{1};
      for (int64_t i = begin; i < end; ++i) {
        const long double tau = static_cast<long double>(samples.sigma[i]) * samples.delta[i];
        transmittance.push_back(transmittance.back() * std::exp(-tau));
      }
      for (int64_t i = begin; i < end; ++i) {
        long double expected = transmittance[i - begin + 1] * color[i] - transmittance.back() * background;
        for (int64_t j = i + 1; j < end; ++j) {
          expected -= (transmittance[j - begin] - transmittance[j - begin + 1]) * color[j];
        }
        // Every term is at most T_{i+1}; rounding of Σ τ adds S·e^−S to each.
        const double tolerance = 4. * static_cast<double>(end - begin) * std::numeric_limits<TypeParam>::epsilon();
        ASSERT_NEAR(gradient[i], static_cast<double>(samples.delta[i] * expected), samples.delta[i] * tolerance);
      }
    }
  }
}

TEST(CompositingInDoubleTest, GradientMatchesFiniteDifferences) {
  const auto samples = MakeSamples<double>(20, 0.5, 6);
  std::mt19937 random(7);
  std::normal_distribution<double> normal;
  std::vector<double> dL_dweights(samples.sigma.size()), dL_dtransmittance(samples.offsets.size() - 1);
  for (double& g : dL_dweights) g = normal(random);
  for (double& g : dL_dtransmittance) g = normal(random);
  const auto loss = [&](const std::vector<double>& sigma) {
    const auto out = Weigh(samples.offsets, sigma, samples.delta);
    double sum = 0;
    for (size_t i = 0; i < sigma.size(); ++i) sum += dL_dweights[i] * out.weights[i];
    for (size_t r = 0; r < dL_dtransmittance.size(); ++r) sum += dL_dtransmittance[r] * out.transmittance[r];
    return sum;
  };
  const auto gradient =
      WeighBackward(samples.offsets, samples.delta, Weigh(samples.offsets, samples.sigma, samples.delta), dL_dweights,
                    dL_dtransmittance);
  for (size_t i = 0; i < samples.sigma.size(); ++i) {
    auto up = samples.sigma, down = samples.sigma;
    const double h = 1e-4 / samples.delta[i];
    up[i] += h;
    down[i] -= h;
    EXPECT_NEAR(gradient[i] / samples.delta[i], (loss(up) - loss(down)) / (2 * h * samples.delta[i]), 1e-7);
  }
}

TYPED_TEST(CompositingTest, SelectionIsTheSamplesAboveTheThresholdInOrder) {
  const auto samples = MakeSamples<TypeParam>(300, 1, 8);
  const auto forward = Weigh(samples.offsets, samples.sigma, samples.delta);
  const SelectArgs<TypeParam> args{300, samples.offsets.data(), forward.weights.data(), static_cast<TypeParam>(1e-2)};
  std::vector<int64_t> offsets(301, -1);
  std::vector<int64_t> indices(CountSelectedCpu(args, offsets.data()), -1);
  FillSelectedCpu(args, offsets.data(), indices.data());
  std::vector<int64_t> expected, expected_offsets{0};
  for (int r = 0; r < 300; ++r) {
    for (int64_t i = samples.offsets[r]; i < samples.offsets[r + 1]; ++i) {
      if (forward.weights[i] > args.threshold) expected.push_back(i);
    }
    expected_offsets.push_back(static_cast<int64_t>(expected.size()));
  }
  EXPECT_EQ(indices, expected);
  EXPECT_EQ(offsets, expected_offsets);
}

TEST(CompositingInDoubleTest, AccumulationIsTheWeightedSumAndItsGradientIsTheTranspose) {
  constexpr int64_t kChannels = 3;
  const auto samples = MakeSamples<double>(100, 1, 9);
  const auto n = static_cast<int64_t>(samples.sigma.size());
  std::mt19937 random(10);
  std::normal_distribution<double> normal;
  const auto draw = [&](int64_t count) {
    std::vector<double> values(count);
    for (double& v : values) v = normal(random);
    return values;
  };
  const auto weights = draw(n), values = draw(n * kChannels), dL_dout = draw(100 * kChannels);
  std::vector<double> out(100 * kChannels, -1), dL_dweights(n, -1), dL_dvalues(n * kChannels, -1);
  AccumulateForwardCpu<double>({100, kChannels, samples.offsets.data(), weights.data(), values.data(), out.data()});
  AccumulateBackwardCpu<double>({100, kChannels, samples.offsets.data(), weights.data(), values.data(), dL_dout.data(),
                                 dL_dweights.data(), dL_dvalues.data()});
  for (int64_t r = 0; r < 100; ++r) {
    for (int64_t c = 0; c < kChannels; ++c) {
      double sum = 0;
      for (int64_t i = samples.offsets[r]; i < samples.offsets[r + 1]; ++i) {
        sum += weights[i] * values[i * kChannels + c];
        EXPECT_EQ(dL_dvalues[i * kChannels + c], weights[i] * dL_dout[r * kChannels + c]);
      }
      EXPECT_NEAR(out[r * kChannels + c], sum, 1e-12);
    }
  }
  // ⟨dL/dout, out⟩ = ⟨dL/dw, w⟩: out is linear in w.
  double by_out = 0, by_weights = 0;
  for (size_t k = 0; k < out.size(); ++k) by_out += dL_dout[k] * out[k];
  for (int64_t i = 0; i < n; ++i) by_weights += dL_dweights[i] * weights[i];
  EXPECT_NEAR(by_out, by_weights, 1e-10);
}

}  // namespace
}  // namespace nrff
