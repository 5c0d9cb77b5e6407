// Transmittance and weights: dT/dt = −σT is stiff where surfaces are. References are in long double, from the numbers
// that the kernels are given, so that all errors are the kernels' own.
//
// u is the unit roundoff. A product σδ is off by u of itself, the sum of them (in double) and its rounding by another
// u, so T = exp(−τ) by 2uτ of itself, and the exponential by 2u more for each ulp of its own. The cases are those of
// one twin of the kernels, the CPU's or CUDA's (compositing_twin.h).

#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <limits>
#include <random>
#include <string>
#include <vector>

#include "tests/stability/compositing_twin.h"
#include "tests/stability/table.h"

namespace nrff::stability {
namespace {

const std::string kPart = std::string("compositing") + kTwinSuffix;

template <typename Scalar>
struct Ray {
  std::vector<Scalar> sigma, delta, weights;
  Scalar transmittance = 0;
  int64_t n_reached = 0;

  int64_t size() const { return int64_t(sigma.size()); }
  void Add(double s, double d) {
    sigma.push_back(Scalar(s));
    delta.push_back(Scalar(d));
  }
  void Composite(double stop = 0) {
    const int64_t offsets[] = {0, size()};
    weights.resize(sigma.size());
    TwinForward(WeightsArgs<Scalar>{.n_rays = 1,
                                    .ray_offsets = offsets,
                                    .sigma = sigma.data(),
                                    .delta = delta.data(),
                                    .stop_transmittance = Scalar(stop),
                                    .weights = weights.data(),
                                    .transmittance = &transmittance,
                                    .n_reached = &n_reached});
  }
  std::vector<Scalar> Backward(const std::vector<Scalar>& d_weights, Scalar d_transmittance) const {
    const int64_t offsets[] = {0, size()};
    std::vector<Scalar> d_sigma(sigma.size());
    TwinBackward(WeightsBackwardArgs<Scalar>{.n_rays = 1,
                                             .ray_offsets = offsets,
                                             .delta = delta.data(),
                                             .weights = weights.data(),
                                             .transmittance = &transmittance,
                                             .n_reached = &n_reached,
                                             .dL_dweights = d_weights.data(),
                                             .dL_dtransmittance = &d_transmittance,
                                             .dL_dsigma = d_sigma.data()});
    return d_sigma;
  }
  long double Thickness() const {
    long double sum = 0;
    for (int64_t i = 0; i < size(); ++i) sum += static_cast<long double>(sigma[i]) * delta[i];
    return sum;
  }
};

// What the largest relative error of T is, and the smallest number that it can be off by.
template <typename Scalar>
double BoundOfTransmittance(long double thickness, int64_t n) {
  // double sums doubles: n roundings of its own.
  const double sum = sizeof(Scalar) == sizeof(double) ? double(n) * kUnit<double> : kUnit<Scalar>;
  const double relative = double(thickness) * (kUnit<Scalar> + sum) + 2 * kTwinExponentialUlps * kUnit<Scalar>;
  return std::min(1.0, relative) * double(std::exp(-thickness)) + double(std::numeric_limits<Scalar>::min());
}

template <typename Scalar>
void CompareTransmittance(Ray<Scalar>& ray, Worst& worst) {
  ray.Composite();
  const long double thickness = ray.Thickness();
  worst.Add(double(std::abs(ray.transmittance - std::exp(-thickness))),
            BoundOfTransmittance<Scalar>(thickness, ray.size()));
}

template <typename Scalar>
class Compositing : public testing::Test {
  void SetUp() override {
    if (!TwinAvailable()) GTEST_SKIP() << "no GPU";
  }
};
using Scalars = testing::Types<float, double>;
TYPED_TEST_SUITE(Compositing, Scalars);

TYPED_TEST(Compositing, TransmittanceOfAnyThicknessAndNumberOfSamples) {
  const std::pair<const char*, std::function<double(double)>> densities[] = {
      {"homogeneous", [](double) { return 1.0; }},
      {"linear", [](double x) { return 2 * x; }},
      {"Gaussian of width 1e-3", [](double x) { return 399 * std::exp(-0.5 * std::pow((x - 0.4) / 1e-3, 2)); }},
      {"step", [](double x) { return x < 1. / 3 ? 0 : 1.5; }},
      {"delta", [](double x) { return std::abs(x - 0.7) < 1e-9 ? 1.0 : 0.0; }},
  };
  for (const auto& [name, density] : densities) {
    Worst worst;
    for (int power = -12; power <= 12; ++power) {
      const double thickness = std::pow(10, power);
      for (const int n : {1, 2, 3, 64, 1000, 65536}) {
        Ray<TypeParam> ray;
        for (int i = 0; i < n; ++i) {
          const double x = std::string(name) == "delta" && i == n / 2 ? 0.7 : (i + 0.5) / n;
          ray.Add(thickness * density(x), 1.0 / n);
        }
        CompareTransmittance(ray, worst);
      }
    }
    worst.Hold(kPart, std::string("transmittance, ") + name,
               std::string(kFormat<TypeParam>) + ", τ 1e-12 to 1e12, 1 to 65,536 samples");
  }
}

TYPED_TEST(Compositing, IrregularZeroAndDenormalIntervals) {
  std::mt19937_64 random(1);
  std::uniform_real_distribution<double> exponent(-30, 3);
  constexpr double kDenormal = std::numeric_limits<TypeParam>::denorm_min();
  Worst worst, sums;
  for (int repeat = 0; repeat < 300; ++repeat) {
    Ray<TypeParam> ray;
    for (int i = 0; i < 200; ++i) {
      const double interval = i % 7 == 0 ? 0 : i % 11 == 0 ? kDenormal * (1 + i) : std::pow(10, exponent(random));
      const double density = i % 13 == 0 ? 0 : i % 17 == 0 ? kDenormal : std::pow(10, exponent(random) / 3);
      ray.Add(density, interval);
    }
    // Products below the normal numbers are off by half the smallest one each.
    CompareTransmittance(ray, worst);
  }
  worst.Hold(kPart, "transmittance, intervals 0, denormal and 1e-30 to 1e3", kFormat<TypeParam>);
}

// w_i is off by 2u τ_{<i} through T and by 6u and the exponential besides; Σ w τ ≤ 1 as ∫ τ e^{−τ} dτ = 1.
TYPED_TEST(Compositing, WeightsAndTransmittanceSumToOneOnAMillionRandomRays) {
  std::mt19937_64 random(2);
  std::uniform_real_distribution<double> unit(0, 1);
  constexpr int kRays = sizeof(TypeParam) == sizeof(float) ? 1'000'000 : 100'000, kAtOnce = 10'000;
  Worst sums, transmittance;
  for (int done = 0; done < kRays; done += kAtOnce) {
    Ray<TypeParam> rays;  // one behind the other
    std::vector<int64_t> offsets = {0};
    for (int r = 0; r < kAtOnce; ++r) {
      const int n = 1 + int(random() % 32);
      const double scale = std::pow(10, 12 * unit(random) - 6);
      for (int i = 0; i < n; ++i) rays.Add(scale * std::pow(10, 6 * unit(random) - 3), 0.01 * unit(random));
      offsets.push_back(rays.size());
    }
    std::vector<TypeParam> weights(rays.size()), behind(kAtOnce);
    std::vector<int64_t> n_reached(kAtOnce);
    TwinForward(WeightsArgs<TypeParam>{.n_rays = kAtOnce,
                                       .ray_offsets = offsets.data(),
                                       .sigma = rays.sigma.data(),
                                       .delta = rays.delta.data(),
                                       .weights = weights.data(),
                                       .transmittance = behind.data(),
                                       .n_reached = n_reached.data()});
    for (int r = 0; r < kAtOnce; ++r) {
      const int64_t n = offsets[r + 1] - offsets[r];
      long double thickness = 0, sum = behind[r];
      for (int64_t i = offsets[r]; i < offsets[r + 1]; ++i) {
        thickness += static_cast<long double>(rays.sigma[i]) * rays.delta[i];
        sum += weights[i];
      }
      transmittance.Add(double(std::abs(behind[r] - std::exp(-thickness))),
                        BoundOfTransmittance<TypeParam>(thickness, n));
      sums.Add(double(std::abs(sum - 1)),
               (8 + 2 * kTwinExponentialUlps + (sizeof(TypeParam) == sizeof(double) ? n : 0)) * kUnit<TypeParam>);
    }
  }
  const std::string condition =
      std::string(kFormat<TypeParam>) + ", " + (kRays == 1'000'000 ? "1,000,000" : "100,000") + " random rays";
  sums.Hold(kPart, "Σ w + T = 1", condition);
  transmittance.Hold(kPart, "transmittance", condition);
}

// An interval cut into 2^k equal ones lets as much light through and takes as much away.
TYPED_TEST(Compositing, SplitIntervalsChangeNothing) {
  std::mt19937_64 random(3);
  std::uniform_real_distribution<double> unit(0, 1);
  Worst worst;
  for (const int parts : {2, 16, 1024}) {
    for (int repeat = 0; repeat < 50; ++repeat) {
      Ray<TypeParam> whole, split;
      for (int i = 0; i < 20; ++i) {
        const double sigma = std::pow(10, 5 * unit(random) - 2), delta = 0.1 * unit(random);
        whole.Add(sigma, delta);
        for (int k = 0; k < parts; ++k) split.Add(sigma, double(TypeParam(delta)) / parts);
      }
      whole.Composite();
      split.Composite();
      worst.Add(std::abs(double(whole.transmittance) - split.transmittance),
                2 * BoundOfTransmittance<TypeParam>(whole.Thickness(), split.size()));
      for (int i = 0; i < 20; ++i) {
        long double sum = 0;
        for (int k = 0; k < parts; ++k) sum += split.weights[i * parts + k];
        worst.Add(double(std::abs(sum - whole.weights[i])),
                  (20 + (sizeof(TypeParam) == sizeof(double) ? split.size() : 0)) * kUnit<TypeParam>);
      }
    }
  }
  worst.Hold(kPart, "intervals cut into 2, 16 and 1024 parts", kFormat<TypeParam>);
}

TYPED_TEST(Compositing, NothingBehindAnOpaqueSampleIsSeen) {
  double most = 0;
  for (const double thickness : {1e3, 1e6, 1e12, double(std::numeric_limits<TypeParam>::max())}) {
    Ray<TypeParam> ray;
    ray.Add(0.1, 1);
    ray.Add(thickness, 1);
    for (int i = 0; i < 100; ++i) ray.Add(1 + i, 0.1);
    ray.Add(double(std::numeric_limits<TypeParam>::max()), 1e10);  // a product beyond the largest number
    ray.Composite();
    EXPECT_TRUE(std::isfinite(ray.weights.back()));
    for (int64_t i = 2; i < ray.size(); ++i) most = std::max(most, double(ray.weights[i]));
    most = std::max(most, double(ray.transmittance));
    for (const TypeParam gradient : ray.Backward(std::vector<TypeParam>(ray.sigma.size(), 1), 1)) {
      EXPECT_TRUE(std::isfinite(gradient));
    }
  }
  Hold(kPart, "weights behind an opaque sample", std::string(kFormat<TypeParam>) + ", τ 1e3 to the largest number",
       most, 0);
}

// Lengths times k with densities over k: the same bits for powers of two.
TYPED_TEST(Compositing, ScalesOfTheWorldChangeNothing) {
  std::mt19937_64 random(4);
  std::uniform_real_distribution<double> unit(0, 1);
  double most = 0;
  for (const int power : {-60, -1, 1, 60}) {
    Ray<TypeParam> ray, scaled;
    for (int i = 0; i < 500; ++i) {
      const double sigma = std::pow(10, 4 * unit(random) - 2), delta = 0.1 * unit(random);
      ray.Add(sigma, delta);
      scaled.Add(std::ldexp(double(TypeParam(sigma)), -power), std::ldexp(double(TypeParam(delta)), power));
    }
    ray.Composite();
    scaled.Composite();
    most = std::max(most, std::abs(double(ray.transmittance) - scaled.transmittance));
    for (int64_t i = 0; i < ray.size(); ++i)
      most = std::max(most, std::abs(double(ray.weights[i]) - scaled.weights[i]));
  }
  Hold(kPart, "lengths times 2^±60, densities over it", kFormat<TypeParam>, most, 0);
}

// dL/dσ_i = δ_i (g_i T_{i+1} − Σ_{j>i} g_j w_j − g_T T): every term is off by what T and w are, and the sums by a
// rounding each.
TYPED_TEST(Compositing, GradientsAreTheClosedForm) {
  std::mt19937_64 random(5);
  std::uniform_real_distribution<double> unit(0, 1);
  Worst worst;
  for (const double scale : {1e-6, 1e-2, 1., 1e2, 1e6}) {
    for (const int n : {1, 10, 1000, 65536}) {
      Ray<TypeParam> ray;
      std::vector<TypeParam> g;
      for (int i = 0; i < n; ++i) {
        ray.Add(scale * unit(random), 1.0 / n);
        g.push_back(TypeParam(2 * unit(random) - 1));
      }
      const auto g_end = TypeParam(0.7);
      ray.Composite();
      const std::vector<TypeParam> d_sigma = ray.Backward(g, g_end);
      std::vector<long double> thickness(n + 1, 0);  // in front of sample i
      for (int i = 0; i < n; ++i)
        thickness[i + 1] = thickness[i] + static_cast<long double>(ray.sigma[i]) * ray.delta[i];
      long double behind = std::abs(static_cast<long double>(g_end)) * std::exp(-thickness[n]), signed_behind = behind;
      for (int i = n - 1; i >= 0; --i) {
        const long double transmittance = std::exp(-thickness[i + 1]);
        const long double weight = std::exp(-thickness[i]) * -std::expm1(-(thickness[i + 1] - thickness[i]));
        const long double expected = ray.delta[i] * (g[i] * transmittance - signed_behind);
        const long double magnitude =
            ray.delta[i] * (std::abs(static_cast<long double>(g[i])) * transmittance + behind);
        const double roundings =
            16 + 4 * std::min(double(thickness[n]), 40.0) + (sizeof(TypeParam) == sizeof(double) ? 3.0 * n : 0);
        worst.Add(double(std::abs(d_sigma[i] - expected)),
                  roundings * kUnit<TypeParam> * double(magnitude) + std::numeric_limits<TypeParam>::min());
        signed_behind += g[i] * weight;
        behind += std::abs(static_cast<long double>(g[i])) * weight;
      }
    }
  }
  worst.Hold(kPart, "dL/dσ against the closed form", std::string(kFormat<TypeParam>) + ", 1 to 65,536 samples");
}

// Central differences extrapolated to step 0 [Ridders82], which know nothing of the closed form.
TEST(CompositingInDouble, GradientsAreRiddersDifferences) {
  if (!TwinAvailable()) GTEST_SKIP() << "no GPU";
  std::mt19937_64 random(6);
  std::uniform_real_distribution<double> unit(0, 1);
  Worst worst;
  for (const double scale : {0.1, 1., 10., 100.}) {
    Ray<double> ray;
    std::vector<double> g;
    for (int i = 0; i < 12; ++i) {
      ray.Add(scale * unit(random), 0.1);
      g.push_back(2 * unit(random) - 1);
    }
    ray.Composite();
    const std::vector<double> d_sigma = ray.Backward(g, 0.7);
    for (int i = 0; i < 12; ++i) {
      const auto loss = [&](double shift) {
        Ray<double> moved = ray;
        moved.sigma[i] += shift;
        moved.Composite();
        double sum = 0.7 * moved.transmittance;
        for (int j = 0; j < 12; ++j) sum += g[j] * moved.weights[j];
        return sum;
      };
      constexpr int kRows = 6;
      double table[kRows][kRows], h = 0.02 / scale * std::max(1.0, scale);
      for (int row = 0; row < kRows; ++row, h /= 2) {
        table[row][0] = (loss(h) - loss(-h)) / (2 * h);
        for (int k = 1; k <= row; ++k) {
          const double factor = std::ldexp(1, 2 * k);
          table[row][k] = (factor * table[row][k - 1] - table[row - 1][k - 1]) / (factor - 1);
        }
      }
      // Rounding of the loss (some u) over the smallest step.
      worst.Add(std::abs(d_sigma[i] - table[kRows - 1][kRows - 1]), 40 * kUnit<double> / (2 * h));
    }
  }
  worst.Hold(kPart, "dL/dσ against Ridders' differences", "double");
}

}  // namespace
}  // namespace nrff::stability
