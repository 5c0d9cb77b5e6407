// Encoding, networks and Adam in float against themselves in double on the same numbers, at the edges of their domains,
// and against laws that need no second computation.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <random>
#include <string>
#include <vector>

#include "model/kernels/adam.h"
#include "model/kernels/ree.h"
#include "model/kernels/tile_gemm.h"
#include "model/kernels/tile_gemm_bf16.h"
#include "tests/stability/table.h"
#include "tests/uniforms.h"

namespace nrff::stability {
namespace {

// With λ and μ themselves given, the exponent λs² is off through s, by 6u λ|s| and 4u λs². |s| e^(−λs²) √λ ≤ 0.43.
TEST(Ree, FloatIsDoubleForAnyLobe) {
  const Lobes lobes = MakeLobes(8, 16);
  const int n_lobes = lobes.size();
  std::vector<float> directions;
  for (const auto& d : std::vector<std::vector<float>>{{0, 0, 1}, {0, 0, -1}, {1, 0, 0}, {0, 1, 0}, {-1, 0, 0}}) {
    directions.insert(directions.end(), d.begin(), d.end());
  }
  std::mt19937 random(7);
  std::normal_distribution<double> normal;
  for (int i = 0; i < 300; ++i) {
    const double x = normal(random), y = normal(random), z = normal(random), norm = std::sqrt(x * x + y * y + z * z);
    for (const double k : {x, y, z}) directions.push_back(float(k / norm));
  }
  const auto n = int64_t(directions.size() / 3);
  for (const float sharpness : {-1e4F, -10.F, 0.F, 10.F, 1e4F}) {
    std::vector<float> raw(n * n_lobes * kLobeParameters);
    for (size_t i = 0; i < raw.size(); ++i) raw[i] = i % kLobeParameters < 2 ? (i % 3 == 0 ? -1.F : 0.7F) : sharpness;
    std::vector<float> encoding(n * n_lobes * kLobeAmplitudes);
    ReeForward(lobes, directions.data(), raw.data(), n, encoding.data());
    const auto exact_directions = Converted<double>(directions), exact_raw = Converted<double>(raw);
    std::vector<double> exact(encoding.size());
    ReeForward(lobes, exact_directions.data(), exact_raw.data(), n, exact.data());
    const double lambda = std::log1p(std::exp(std::min(sharpness, 30.F) - 1)) + std::max(sharpness - 30.F, 0.F);
    Worst worst;
    for (size_t i = 0; i < exact.size(); ++i) {
      worst.Add(std::abs(encoding[i] - exact[i]), (16 + 2 * 6 * std::sqrt(lambda)) * kUnit<float>);
    }
    worst.Hold("REE", "encoding", "float against double, raw λ and μ " + std::to_string(int(sharpness)));
  }
}

// Turning the world about z by the lobes' own spacing moves every lobe to the next.
TEST(Ree, TurnsWithTheWorld) {
  const Lobes lobes = MakeLobes(5, 9);
  const int n_phi = lobes.n_phi, n_lobes = lobes.size();
  const auto raw = Uniforms(n_lobes * kLobeParameters, -3, 3, 8);
  Worst worst;
  for (int i = 0; i < 200; ++i) {
    const auto v = Uniforms(3, -1, 1, 100 + i);
    const double norm = std::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
    const double o[3] = {v[0] / norm, v[1] / norm, v[2] / norm};
    const double angle = 2 * std::numbers::pi / (n_phi - 1);
    const double turned[3] = {std::cos(angle) * o[0] - std::sin(angle) * o[1],
                              std::sin(angle) * o[0] + std::cos(angle) * o[1], o[2]};
    std::vector<double> raw_turned(raw.size()), encoding(n_lobes * 2), encoding_turned(n_lobes * 2);
    const auto next = [&](int lobe) { return lobe / n_phi * n_phi + (lobe % n_phi + 1) % n_phi; };
    for (int k = 0; k < n_lobes; ++k) {
      for (int p = 0; p < kLobeParameters; ++p)
        raw_turned[next(k) * kLobeParameters + p] = raw[k * kLobeParameters + p];
    }
    ReeForward(lobes, o, raw.data(), 1, encoding.data());
    ReeForward(lobes, turned, raw_turned.data(), 1, encoding_turned.data());
    for (int k = 0; k < n_lobes; ++k) {
      if (k % n_phi + 1 == n_phi) continue;  // the last repeats the first: its next is the second, not the first
      for (int a = 0; a < 2; ++a) {
        worst.Add(std::abs(encoding[2 * k + a] - encoding_turned[2 * next(k) + a]), 200 * kUnit<double>);
      }
    }
  }
  worst.Hold("REE", "turned with the world", "by the lobes' spacing, double");
}

// A product of k pairs of numbers rounded to 8 bits is off by 2^−8 of Σ |a b| at the most, by 2^−16 where both are
// split in two, and by k roundings of float.
TEST(Mlp, ProductsOfALayerInBf16AndSplitBf16) {
  for (const auto precision : {GemmPrecision::kFloat, GemmPrecision::kBf16}) {
    Worst worst;
    for (const double scale : {1e-30, 1e-6, 1., 1e6, 1e15}) {
      for (const int64_t k : {16, 192, 545}) {
        constexpr int64_t kM = 64, kN = 96;
        const auto a = Converted<float>(Uniforms(kM * k, -scale, scale, 9)),
                   b = Converted<float>(Uniforms(k * kN, -1, 1, 10));
        std::vector<float> c(kM * kN);
        const GemmArgs args{.m = kM,
                            .n = kN,
                            .k = k,
                            .a = a.data(),
                            .a_row = k,
                            .a_column = 1,
                            .b = b.data(),
                            .b_row = kN,
                            .c = c.data(),
                            .c_row = kN,
                            .precision = precision};
        TileGemm(args);
        for (int64_t i = 0; i < kM; ++i) {
          for (int64_t j = 0; j < kN; ++j) {
            double exact = 0, magnitude = 0;
            for (int64_t l = 0; l < k; ++l) {
              const double product = double(a[i * k + l]) * b[l * kN + j];
              exact += product;
              magnitude += std::abs(product);
            }
            const double rounding = !Bf16Pays(args) ? 0 : precision == GemmPrecision::kFloat ? 0x1p-16 : 1.01 * 0x1p-8;
            worst.Add(std::abs(c[i * kN + j] - exact), (rounding + double(k + 2) * kUnit<float>)*magnitude);
          }
        }
      }
    }
    worst.Hold(
        "MLP", "a layer's product, weights 1e-30 to 1e15",
        precision == GemmPrecision::kFloat ? "training (split bf16 on AMX)" : "pictures (bf16 on AMX and AVX-512)");
  }
}

// Under a constant gradient g every step is lr·g/(|g| + ε) from the first on; float's own roundings of the parameter
// and of both moments add up over the steps.
TEST(Adam, ConstantGradientsOfAnySizeForAMillionSteps) {
  constexpr int64_t kSteps = 1'000'000;
  const AdamOptions options{.learning_rate = 1e-6, .epsilon = 1e-15};
  const std::vector<float> gradient = {0.F, 1e-12F, -1e-3F, 1.F, -1e9F};
  const auto n = int64_t(gradient.size());
  std::vector<float> parameters(n, 0), m(n, 0), v(n, 0);
  for (int64_t t = 1; t <= kSteps; ++t) {
    AdamStep(options, t, n, gradient.data(), parameters.data(), m.data(), v.data());
  }
  Worst worst;
  for (int64_t i = 0; i < n; ++i) {
    const double g = gradient[i];
    const double expected = -options.learning_rate * kSteps * g / (std::abs(g) + options.epsilon);
    // A step's roundings (8u) and half an ulp of the parameter, a million times.
    worst.Add(std::abs(parameters[i] - expected),
              kSteps * (8 * options.learning_rate + std::abs(expected)) * kUnit<float>);
  }
  worst.Hold("Adam", "a million steps under a constant gradient", "float, gradients 0 to 1e9");
}

// Squares of gradients leave float's range below 1e-23 and above 1e19; what is left must be a finite step that is not
// larger than the rate allows.
TEST(Adam, GradientsOutsideTheRangeOfSquares) {
  const AdamOptions options{.learning_rate = 0.01, .epsilon = 1e-8};
  const std::vector<float> gradient = {1e-45F, -1e-38F, 1e-23F, 1e19F, -1e25F, std::numeric_limits<float>::max()};
  const auto n = int64_t(gradient.size());
  std::vector<float> parameters(n, 0), m(n, 0), v(n, 0);
  AdamStep(options, 1, n, gradient.data(), parameters.data(), m.data(), v.data());
  double beyond = 0;
  for (const float parameter : parameters) {
    if (!std::isfinite(parameter)) beyond = HUGE_VAL;
    beyond = std::max(beyond, std::abs(double(parameter)) - options.learning_rate);
  }
  Hold("Adam", "first step's length beyond the rate", "float, gradients of 1e-45 to 3e38", beyond,
       16 * kUnit<float> * options.learning_rate);
}

}  // namespace
}  // namespace nrff::stability
