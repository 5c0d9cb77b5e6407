// The model's kernels in float against themselves in double on the same numbers, at the edges of their domains, and
// against laws that need no second computation.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <random>
#include <string>
#include <vector>

#include "model/kernels/adam.h"
#include "model/kernels/feature_grid.h"
#include "model/kernels/ree.h"
#include "model/kernels/tile_gemm.h"
#include "model/kernels/tile_gemm_amx.h"
#include "tests/stability/table.h"
#include "tests/uniforms.h"

namespace nrff::stability {
namespace {

constexpr float kInfinity = std::numeric_limits<float>::infinity();

template <typename To, typename From>
std::vector<To> Converted(const std::vector<From>& values) {
  return {values.begin(), values.end()};
}

template <typename Scalar>
std::vector<Scalar> Concat(const GridLayout& layout, const std::vector<Scalar>& parameters,
                           const std::vector<Scalar>& points) {
  std::vector<Scalar> features(points.size() / 3 * layout.n_features());
  GridConcatForward(layout, parameters.data(), points.data(), int64_t(points.size() / 3), features.data());
  return features;
}

TEST(Grid, BeyondTheEndsIsTheEnd) {
  const GridLayout layout = MakeGridLayout(4, 5, 512, 4);
  const auto parameters = Converted<float>(Uniforms(layout.n_parameters, -1, 1, 1));
  double most = 0;
  for (int axis = 0; axis < 3; ++axis) {
    for (const float end : {-1.F, 1.F}) {
      const float ulp = std::nextafter(end, 2 * end);
      for (const float beyond : {ulp, 2 * end, 1e30F * end, kInfinity * end, std::nanf("")}) {
        std::vector<float> at = {0.3F, -0.2F, 0.7F}, outside = at;
        at[axis] = std::isnan(beyond) ? -1.F : end;
        outside[axis] = beyond;
        const auto expected = Concat(layout, parameters, at), actual = Concat(layout, parameters, outside);
        for (size_t i = 0; i < expected.size(); ++i) most = std::max(most, std::abs(double(expected[i]) - actual[i]));
      }
    }
  }
  Hold("grid", "value beyond an end", "an ulp to infinity, NaN as −1", most, 0);
}

// A coordinate's place among n nodes is off by 2u(n − 1); planes and lines, all below 1, change by 2 at most from node
// to node; a plane has two coordinates, a line one. 16 roundings of interpolation besides.
TEST(Grid, FloatIsDoubleToTheirPlacesRounding) {
  const GridLayout layout = MakeGridLayout(6, 4, 1024, 4);
  const auto parameters = Converted<float>(Uniforms(layout.n_parameters, -1, 1, 2));
  auto points = Converted<float>(Uniforms(3 * 3000, -1, 1, 3));
  for (int i = 0; i < 60; ++i) points[i] = i % 2 == 0 ? std::nextafter(1.F, 0.F) : std::nextafter(-1.F, 0.F);
  const auto n = int64_t(points.size() / 3);
  const auto features = Concat(layout, parameters, points);
  const auto exact = Concat(layout, Converted<double>(parameters), Converted<double>(points));
  Worst worst;
  for (int row = 0; row < layout.n_products(); ++row) {
    const int level = row / 3;
    const double last = layout.levels[level].resolution - 1;
    for (int64_t i = row * n * 4; i < (row + 1) * n * 4; ++i) {
      worst.Add(std::abs(features[i] - exact[i]), (12 * last + 16) * kUnit<float>);
    }
  }
  worst.Hold("grid", "features", "float against double, 4 to 1024 nodes");
}

// How many points are beside each node of a plane or line, in the order of the parameters' nodes.
std::vector<int> PointsBeside(const GridLayout& layout, const std::vector<float>& points) {
  std::vector<int> beside(layout.n_parameters / layout.n_channels, 0);
  for (size_t i = 0; i < points.size(); i += 3) {
    for (const GridLayout::Level& level : layout.levels) {
      int cell[3];
      for (int k = 0; k < 3; ++k) {
        const double node = (std::clamp(double(points[i + k]), -1., 1.) + 1) / 2 * (level.resolution - 1);
        cell[k] = std::min(int(node), level.resolution - 2);
      }
      for (int p = 0; p < 3; ++p) {
        const GridProduct& product = kGridProducts[p];
        for (int a = 0; a < 2; ++a) {
          ++beside[level.line_offsets[p] / layout.n_channels + cell[product.line_axis] + a];
          for (int b = 0; b < 2; ++b) {
            ++beside[level.plane_offsets[p] / layout.n_channels + (cell[product.row_axis] + a) * level.resolution +
                     cell[product.column_axis] + b];
          }
        }
      }
    }
  }
  return beside;
}

// A node's gradient is a sum over the points beside it; every term is off by its point's place (12u(n − 1), as above)
// and by interpolation's roundings, and the sum by one rounding a term. Σ |term| is the gradient for absolute values.
TEST(Grid, GradientsInFloatAreThoseInDouble) {
  const GridLayout layout = MakeGridLayout(3, 4, 64, 4);
  const auto parameters = Converted<float>(Uniforms(layout.n_parameters, -1, 1, 4));
  const auto points = Converted<float>(Uniforms(3 * 5000, -1.1, 1.1, 5));
  const auto n = int64_t(points.size() / 3);
  const auto d_features = Converted<float>(Uniforms(layout.n_features() * n, -1, 1, 6));
  const auto exact_points = Converted<double>(points);
  std::vector<double> size_parameters = Converted<double>(parameters), size_d = Converted<double>(d_features);
  const auto exact_parameters = size_parameters, exact_d = size_d;
  for (double& value : size_parameters) value = 1;  // |p| ≤ 1
  for (double& value : size_d) value = std::abs(value);
  std::vector<float> gradient(layout.n_parameters, 0);
  std::vector<double> exact(layout.n_parameters, 0), size(layout.n_parameters, 0);
  for (int p = 0; p < layout.n_products(); ++p) {
    const int64_t at = p * n * 4;
    GridConcatBackward(layout, p, parameters.data(), points.data(), n, d_features.data() + at, gradient.data());
    GridConcatBackward(layout, p, exact_parameters.data(), exact_points.data(), n, exact_d.data() + at, exact.data());
    GridConcatBackward(layout, p, size_parameters.data(), exact_points.data(), n, size_d.data() + at, size.data());
  }
  const std::vector<int> beside = PointsBeside(layout, points);
  Worst worst;
  for (int64_t i = 0; i < layout.n_parameters; ++i) {
    size_t level = 0;
    while (level + 1 < layout.levels.size() && layout.levels[level + 1].plane_offsets[0] <= i) ++level;
    const double last = layout.levels[level].resolution - 1, n_terms = beside[i / layout.n_channels];
    worst.Add(std::abs(gradient[i] - exact[i]), kUnit<float> * (12 * last * n_terms + (n_terms + 32) * size[i]));
  }
  worst.Hold("grid", "gradients of planes and lines", "float against double, 5,000 points");
}

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
        TileGemm({.m = kM,
                  .n = kN,
                  .k = k,
                  .a = a.data(),
                  .a_row = k,
                  .a_column = 1,
                  .b = b.data(),
                  .b_row = kN,
                  .c = c.data(),
                  .c_row = kN,
                  .precision = precision});
        for (int64_t i = 0; i < kM; ++i) {
          for (int64_t j = 0; j < kN; ++j) {
            double exact = 0, magnitude = 0;
            for (int64_t l = 0; l < k; ++l) {
              const double product = double(a[i * k + l]) * b[l * kN + j];
              exact += product;
              magnitude += std::abs(product);
            }
            const double rounding = !AmxAvailable() ? 0 : precision == GemmPrecision::kFloat ? 0x1p-16 : 1.01 * 0x1p-8;
            worst.Add(std::abs(c[i * kN + j] - exact), (rounding + double(k + 2) * kUnit<float>)*magnitude);
          }
        }
      }
    }
    worst.Hold("MLP", "a layer's product, weights 1e-30 to 1e15",
               precision == GemmPrecision::kFloat ? "training (split bf16 on AMX)" : "pictures (bf16 on AMX)");
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
