// Laws of the model's kernels: what grids reproduce exactly, derivatives, closed forms, determinism.

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <omp.h>

#include <cmath>
#include <functional>
#include <limits>
#include <numbers>
#include <vector>

#include "model/kernels/adam.h"
#include "model/kernels/fast_math.h"
#include "model/kernels/feature_grid.h"
#include "model/kernels/ree.h"
#include "model/kernels/tile_rows.h"
#include "tests/uniforms.h"

namespace nrff {
namespace {

using ::testing::ElementsAre;

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

double Dot(const std::vector<double>& a, const std::vector<double>& b) {
  double sum = 0;
  for (size_t i = 0; i < a.size(); ++i) sum += a[i] * b[i];
  return sum;
}

std::vector<double> Plus(const std::vector<double>& a, double scale, const std::vector<double>& b) {
  std::vector<double> sum = a;
  for (size_t i = 0; i < a.size(); ++i) sum[i] += scale * b[i];
  return sum;
}

// upstream · (f(x + h·direction) − f(x − h·direction)) / 2h
double DirectionalDerivative(const std::function<std::vector<double>(const std::vector<double>&)>& f,
                             const std::vector<double>& x, const std::vector<double>& direction,
                             const std::vector<double>& upstream, double h) {
  return (Dot(upstream, f(Plus(x, h, direction))) - Dot(upstream, f(Plus(x, -h, direction)))) / (2 * h);
}

std::vector<double> Concat(const GridLayout& layout, const std::vector<double>& parameters,
                           const std::vector<double>& points) {
  std::vector<double> features(points.size() / 3 * layout.n_features());
  GridConcatForward(layout, parameters.data(), points.data(), int64_t(points.size() / 3), features.data());
  return features;
}

// Over all products; d_features as GridConcatForward's features.
template <typename Scalar>
void AccumulateConcat(const GridLayout& layout, const std::vector<Scalar>& parameters,
                      const std::vector<Scalar>& points, const std::vector<Scalar>& d_features,
                      std::vector<Scalar>& gradient) {
  const auto n = int64_t(points.size() / 3);
  for (int p = 0; p < layout.n_products(); ++p) {
    GridConcatBackward(layout, p, parameters.data(), points.data(), n, d_features.data() + p * n * layout.n_channels,
                       gradient.data());
  }
}

void AccumulateSum(const GridLayout& layout, const std::vector<double>& parameters, const std::vector<double>& points,
                   const std::vector<double>& d_feature, std::vector<double>& gradient) {
  for (int p = 0; p < layout.n_products(); ++p) {
    GridSumBackward(layout, p, parameters.data(), points.data(), int64_t(points.size() / 3), d_feature.data(),
                    gradient.data());
  }
}

std::vector<double> Sum(const GridLayout& layout, const std::vector<double>& parameters,
                        const std::vector<double>& points) {
  std::vector<double> feature(points.size() / 3);
  GridSumForward(layout, parameters.data(), points.data(), int64_t(feature.size()), feature.data());
  return feature;
}

TEST(GridLayout, HasThePapersResolutionsAndSize) {
  const GridLayout density = MakeGridLayout(16, 16, 512, 2), appearance = MakeGridLayout(16, 16, 512, 4);
  std::vector<int> resolutions;
  for (const auto& level : density.levels) resolutions.push_back(level.resolution);
  EXPECT_THAT(resolutions, ElementsAre(16, 20, 25, 32, 40, 50, 64, 80, 101, 128, 161, 203, 256, 322, 406, 512));
  EXPECT_NEAR(double(density.n_parameters + appearance.n_parameters), 12.8e6, 0.05e6);
  EXPECT_EQ(appearance.n_features(), 192);
}

TEST(GridLayout, RefusesWhatCannotBe) {
  EXPECT_THROW(MakeGridLayout(0, 16, 32, 2), std::invalid_argument);
  EXPECT_THROW(MakeGridLayout(2, 1, 32, 2), std::invalid_argument);
  EXPECT_THROW(MakeGridLayout(2, 16, 8, 2), std::invalid_argument);
  EXPECT_THROW(MakeGridLayout(2, 16, 32, 3), std::invalid_argument);
}

class FeatureGrid : public ::testing::TestWithParam<int> {
 protected:
  GridLayout layout_ = MakeGridLayout(3, 3, 9, GetParam());
};

// Planes a + b·column + c·row and lines d + e·t are their own interpolants, so products are known everywhere.
TEST_P(FeatureGrid, ReproducesLinearFactorsExactlyAndHoldsTheirEndsOutside) {
  const int n_channels = layout_.n_channels;
  const auto plane = [](int l, int p, int c, double column, double row) {
    return 0.3 + l + 0.5 * c + (1 + p) * column - (0.7 + c) * row;
  };
  const auto line = [](int l, int p, int c, double t) { return 1.1 - 0.2 * l + (0.4 * p + 0.1 * c + 0.3) * t; };
  std::vector<double> parameters(layout_.n_parameters);
  for (int l = 0; l < 3; ++l) {
    const auto& level = layout_.levels[l];
    const auto node = [&](int i) { return 2. * i / (level.resolution - 1) - 1; };
    for (int p = 0; p < 3; ++p) {
      for (int row = 0; row < level.resolution; ++row) {
        for (int c = 0; c < n_channels; ++c) {
          parameters[level.line_offsets[p] + row * n_channels + c] = line(l, p, c, node(row));
          for (int column = 0; column < level.resolution; ++column) {
            parameters[level.plane_offsets[p] + (row * level.resolution + column) * n_channels + c] =
                plane(l, p, c, node(column), node(row));
          }
        }
      }
    }
  }
  std::vector<double> points = Uniforms(3 * 50, -1, 1, 1);
  for (const double edge : {-1., 1., -0.5, 0., 0.5, 1.7, -3., 1e30, -1e30})
    points.insert(points.end(), {edge, -edge, edge});
  const std::vector<double> features = Concat(layout_, parameters, points), sums = Sum(layout_, parameters, points);
  for (size_t i = 0; i < points.size() / 3; ++i) {
    double sum = 0;
    for (int l = 0; l < 3; ++l) {
      for (int p = 0; p < 3; ++p) {
        const auto& product = kGridProducts[p];
        const auto at = [&](int axis) { return std::clamp(points[3 * i + axis], -1., 1.); };
        for (int c = 0; c < n_channels; ++c) {
          const double expected =
              plane(l, p, c, at(product.column_axis), at(product.row_axis)) * line(l, p, c, at(product.line_axis));
          EXPECT_NEAR(features[((l * 3 + p) * points.size() / 3 + i) * n_channels + c], expected, 1e-13);
          sum += expected;
        }
      }
    }
    EXPECT_NEAR(sums[i], sum, 1e-12);
  }
}

// Features are quadratic in the parameters, so central differences are exact but for rounding.
TEST_P(FeatureGrid, BackwardIsTheAdjointOfTheDerivative) {
  const auto points = Uniforms(3 * 300, -1.1, 1.1, 2);
  const auto parameters = Uniforms(layout_.n_parameters, -1, 1, 3),
             direction = Uniforms(layout_.n_parameters, -1, 1, 4);
  const auto upstream = Uniforms(300 * layout_.n_features(), -1, 1, 5), upstream_sum = Uniforms(300, -1, 1, 6);

  std::vector<double> gradient(parameters.size());
  AccumulateConcat(layout_, parameters, points, upstream, gradient);
  const double expected = DirectionalDerivative([&](const auto& x) { return Concat(layout_, x, points); }, parameters,
                                                direction, upstream, 0.5);
  EXPECT_NEAR(Dot(gradient, direction), expected, 1e-9 * std::abs(expected) + 1e-10);

  std::vector<double> gradient_sum(parameters.size());
  AccumulateSum(layout_, parameters, points, upstream_sum, gradient_sum);
  const double expected_sum = DirectionalDerivative([&](const auto& x) { return Sum(layout_, x, points); }, parameters,
                                                    direction, upstream_sum, 0.5);
  EXPECT_NEAR(Dot(gradient_sum, direction), expected_sum, 1e-9 * std::abs(expected_sum) + 1e-10);
}

TEST_P(FeatureGrid, BackwardAccumulates) {
  const auto points = Uniforms(3 * 10, -1, 1, 2), parameters = Uniforms(layout_.n_parameters, -1, 1, 3);
  const auto upstream = Uniforms(10, -1, 1, 4);
  std::vector<double> once(parameters.size()), after(parameters.size(), 3.);
  AccumulateSum(layout_, parameters, points, upstream, once);
  AccumulateSum(layout_, parameters, points, upstream, after);
  for (size_t i = 0; i < once.size(); ++i) EXPECT_NEAR(after[i], 3 + once[i], 1e-14);
}

TEST_P(FeatureGrid, FloatAgreesWithDouble) {
  const int n = 1000;
  const auto points = Uniforms(3 * n, -1, 1, 2), parameters = Uniforms(layout_.n_parameters, -1, 1, 3);
  const auto upstream = Uniforms(n * layout_.n_features(), -1, 1, 4);
  const std::vector<float> points_f(points.begin(), points.end()), parameters_f(parameters.begin(), parameters.end()),
      upstream_f(upstream.begin(), upstream.end());
  std::vector<double> gradient(parameters.size());
  AccumulateConcat(layout_, parameters, points, upstream, gradient);
  const std::vector<double> features = Concat(layout_, parameters, points);
  std::vector<float> features_f(features.size()), gradient_f(parameters.size());
  GridConcatForward(layout_, parameters_f.data(), points_f.data(), n, features_f.data());
  for (size_t i = 0; i < features.size(); ++i) ASSERT_NEAR(features_f[i], features[i], 1e-5);
  AccumulateConcat(layout_, parameters_f, points_f, upstream_f, gradient_f);
  for (size_t i = 0; i < gradient.size(); ++i) ASSERT_NEAR(gradient_f[i], gradient[i], 1e-3);
}

TEST_P(FeatureGrid, CoordinatesThatAreNotNumbersReadTheFirstNode) {
  const auto parameters = Uniforms(layout_.n_parameters, -1, 1, 3);
  EXPECT_EQ(Sum(layout_, parameters, {kNaN, 0.2, -0.4}), Sum(layout_, parameters, {-1, 0.2, -0.4}));
}

INSTANTIATE_TEST_SUITE_P(Channels, FeatureGrid, ::testing::Values(2, 4));

TEST(DensityActivation, IsSoftplusAndItsDerivativeFromNothingToOpaque) {
  for (int i = 0; i < 190; ++i) {
    const double f = -30 + 0.37 * i;
    auto sigma = float(f), d = 2.F;
    DensitiesFromFeatures(25, -4, 1, &sigma);
    DensityGradients(25, &sigma, 1, &d);
    const double x = double(float(f)) - 4, softplus = std::max(x, 0.) + std::log1p(std::exp(-std::abs(x)));
    // x is a float: its rounding moves e^x by 2⁻²⁴·|x|.
    EXPECT_NEAR(sigma, 25 * softplus, 25 * softplus * (1e-6 + 1.2e-7 * std::abs(x))) << f;
    EXPECT_NEAR(d, 50 / (1 + std::exp(-x)), 50 / (1 + std::exp(-x)) * (3e-6 + 1.2e-7 * std::abs(x))) << f;
  }
}

TEST(FastMath, GeluAndItsDerivative) {
  for (int i = 0; i < 1385; ++i) {
    const double x = -9 + 0.013 * i;
    const double exact = float(x), cdf = 0.5 * std::erfc(-exact / std::numbers::sqrt2);
    const double pdf = std::exp(-exact * exact / 2) / std::sqrt(2 * std::numbers::pi);
    float gelu = 0, derivative = 0;
    FastGelu(float(x), gelu, derivative);
    EXPECT_NEAR(gelu, exact * cdf, 2.5e-7 * std::max(1., std::abs(exact))) << x;
    EXPECT_NEAR(derivative, cdf + exact * pdf, 5e-7) << x;
  }
}

TEST(FastMath, GeluOfLargeNumbers) {
  for (const float x : {12.F, 13.F, 1e4F, 1e30F}) {
    float gelu = 0, derivative = 0;
    FastGelu(x, gelu, derivative);
    EXPECT_EQ(gelu, x);
    EXPECT_EQ(derivative, 1);
    FastGelu(-x, gelu, derivative);
    EXPECT_EQ(gelu, 0);
    EXPECT_NEAR(derivative, 0, 1e-30);
  }
  float gelu = 0, derivative = 0;
  FastGelu(NAN, gelu, derivative);
  EXPECT_TRUE(std::isnan(gelu));
}

// raw such that softplus(raw − 1) = x
double RawOf(double x) { return std::log(std::expm1(x)) + 1; }

// o·dω over the hemisphere in the frame of lobe k, by the midpoint rule in (cos θ, φ).
double HemisphereIntegral(const Lobes& lobes, int k, double lambda, double mu) {
  constexpr int kSteps = 300;
  const double st = lobes.sin_theta[k], ct = lobes.cos_theta[k], sp = lobes.sin_phi[k], cp = lobes.cos_phi[k];
  const double axes[3][3] = {{ct * cp, ct * sp, -st}, {-sp, cp, 0}, {st * cp, st * sp, ct}};
  std::vector<double> directions;
  for (int i = 0; i < kSteps; ++i) {
    const double z = (i + 0.5) / kSteps, r = std::sqrt(1 - z * z);
    for (int j = 0; j < kSteps; ++j) {
      const double phi = 2 * std::numbers::pi * (j + 0.5) / kSteps;
      const double local[3] = {r * std::cos(phi), r * std::sin(phi), z};
      for (int c = 0; c < 3; ++c) {
        directions.push_back(local[0] * axes[0][c] + local[1] * axes[1][c] + local[2] * axes[2][c]);
      }
    }
  }
  const int n = kSteps * kSteps;
  std::vector<double> raw(size_t(n) * lobes.size() * kLobeParameters),
      encoding(size_t(n) * lobes.size() * kLobeAmplitudes);
  for (int i = 0; i < n; ++i) {
    double* lobe = &raw[(size_t(i) * lobes.size() + k) * kLobeParameters];
    lobe[0] = 1;
    lobe[1] = -2;
    lobe[2] = RawOf(lambda);
    lobe[3] = RawOf(mu);
  }
  ReeForward(lobes, directions.data(), raw.data(), n, encoding.data());
  double sum = 0;
  for (int i = 0; i < n; ++i) {
    const double* value = &encoding[(size_t(i) * lobes.size() + k) * kLobeAmplitudes];
    EXPECT_NEAR(value[1], -2 * value[0], 1e-12);
    sum += value[0];
  }
  return sum * 2 * std::numbers::pi / n;
}

TEST(Ree, RoundLobesIntegrateToTheClosedForm) {
  const Lobes lobes = MakeLobes(3, 4);
  for (const int k : {0, 5, 6, 11}) {
    for (const double lambda : {0.3, 2., 10.}) {
      EXPECT_NEAR(HemisphereIntegral(lobes, k, lambda, lambda), std::numbers::pi / lambda * -std::expm1(-lambda), 1e-4);
    }
  }
}

// With μ → 0 the exponential depends on one coordinate of the projected disc: ∫ e^{−λu²} 2√(1−u²) du.
TEST(Ree, NarrowLobesLieAlongTheirOwnAxis) {
  const Lobes lobes = MakeLobes(3, 4);
  const double lambda = 8;
  double expected = 0;
  constexpr int kSteps = 20000;
  for (int i = 0; i < kSteps; ++i) {
    const double u = -1 + 2 * (i + 0.5) / kSteps;
    expected += std::exp(-lambda * u * u) * 2 * std::sqrt(1 - u * u) * 2 / kSteps;
  }
  EXPECT_NEAR(HemisphereIntegral(lobes, 5, lambda, 1e-9), expected, 1e-4);
  EXPECT_NEAR(HemisphereIntegral(lobes, 5, 1e-9, lambda), expected, 1e-4);
}

struct ReeInput {
  Lobes lobes = MakeLobes(3, 5);
  std::vector<double> directions, raw;
  static constexpr int kCount = 20;
  ReeInput() : directions(Uniforms(3 * kCount, -1, 1, 1)), raw(Uniforms(kCount * 15 * kLobeParameters, -3, 3, 2)) {
    for (int i = 0; i < kCount; ++i) {
      double* d = &directions[3 * i];
      const double norm = std::sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
      for (int k = 0; k < 3; ++k) d[k] /= norm;
    }
  }
};

TEST(Ree, GradientsAgreeWithDifferences) {
  const ReeInput in;
  const auto forward = [&](const std::vector<double>& directions, const std::vector<double>& raw) {
    std::vector<double> encoding(ReeInput::kCount * in.lobes.size() * kLobeAmplitudes);
    ReeForward(in.lobes, directions.data(), raw.data(), ReeInput::kCount, encoding.data());
    return encoding;
  };
  const auto upstream = Uniforms(ReeInput::kCount * in.lobes.size() * kLobeAmplitudes, -1, 1, 3);
  std::vector<double> d_directions(in.directions.size(), kNaN), d_raw(in.raw.size(), kNaN);  // overwritten
  ReeBackward(in.lobes, in.directions.data(), in.raw.data(), ReeInput::kCount, upstream.data(), d_directions.data(),
              d_raw.data());
  for (size_t i = 0; i < in.directions.size(); ++i) {
    std::vector<double> direction(in.directions.size());
    direction[i] = 1;
    const double expected = DirectionalDerivative([&](const auto& x) { return forward(x, in.raw); }, in.directions,
                                                  direction, upstream, 1e-6);
    EXPECT_NEAR(d_directions[i], expected, 1e-7 * (1 + std::abs(expected)));
  }
  const auto direction = Uniforms(in.raw.size(), -1, 1, 4);
  const double expected = DirectionalDerivative([&](const auto& x) { return forward(in.directions, x); }, in.raw,
                                                direction, upstream, 1e-6);
  EXPECT_NEAR(Dot(d_raw, direction), expected, 1e-7 * std::abs(expected));
}

TEST(Ree, FloatAgreesWithDouble) {
  const ReeInput in;
  const std::vector<float> directions(in.directions.begin(), in.directions.end()), raw(in.raw.begin(), in.raw.end());
  const auto upstream = Uniforms(ReeInput::kCount * in.lobes.size() * kLobeAmplitudes, -1, 1, 3);
  const std::vector<float> upstream_f(upstream.begin(), upstream.end());
  std::vector<double> encoding(upstream.size()), d_directions(in.directions.size()), d_raw(in.raw.size());
  std::vector<float> encoding_f(upstream.size()), d_directions_f(in.directions.size()), d_raw_f(in.raw.size());
  ReeForward(in.lobes, in.directions.data(), in.raw.data(), ReeInput::kCount, encoding.data());
  ReeForward(in.lobes, directions.data(), raw.data(), ReeInput::kCount, encoding_f.data());
  ReeBackward(in.lobes, in.directions.data(), in.raw.data(), ReeInput::kCount, upstream.data(), d_directions.data(),
              d_raw.data());
  ReeBackward(in.lobes, directions.data(), raw.data(), ReeInput::kCount, upstream_f.data(), d_directions_f.data(),
              d_raw_f.data());
  for (size_t i = 0; i < encoding.size(); ++i) EXPECT_NEAR(encoding_f[i], encoding[i], 3e-6);
  for (size_t i = 0; i < d_raw.size(); ++i) EXPECT_NEAR(d_raw_f[i], d_raw[i], 3e-6);
  for (size_t i = 0; i < d_directions.size(); ++i) EXPECT_NEAR(d_directions_f[i], d_directions[i], 1e-4);
}

TEST(Ree, StaysFiniteAtExtremes) {
  const Lobes lobes = MakeLobes(2, 2);
  for (const float extreme : {1e4F, -1e4F, 1e30F, -1e30F}) {
    const std::vector<float> direction{0, 0.6F, 0.8F}, upstream(4 * kLobeAmplitudes, 1);
    std::vector<float> raw(4 * kLobeParameters, extreme), encoding(upstream.size()), d_direction(3), d_raw(raw.size());
    for (size_t i = 0; i < raw.size(); i += kLobeParameters) raw[i] = raw[i + 1] = 1;
    ReeForward(lobes, direction.data(), raw.data(), 1, encoding.data());
    ReeBackward(lobes, direction.data(), raw.data(), 1, upstream.data(), d_direction.data(), d_raw.data());
    EXPECT_TRUE(AllFinite(encoding.data(), int64_t(encoding.size()))) << extreme;
    EXPECT_TRUE(AllFinite(d_raw.data(), int64_t(d_raw.size()))) << extreme;
    EXPECT_TRUE(AllFinite(d_direction.data(), 3)) << extreme;
  }
}

TEST(FastMath, IsWithinTwoUlp) {
  constexpr double kUlp = std::numeric_limits<float>::epsilon();
  for (int i = 0; i <= 100000; ++i) {
    const auto x = float(-87 + 175. * i / 100000);
    EXPECT_NEAR(FastExp(x) / std::exp(double(x)), 1, 2 * kUlp) << x;
    const float y = float(i) / 100000;
    EXPECT_NEAR(FastLog1p(y), std::log1p(double(y)), 2 * kUlp * std::log1p(double(y))) << y;
  }
  EXPECT_EQ(FastExp(-1e30F), FastExp(-87.F));
}

TEST(Adam, WalksAtTheLearningRateUnderAConstantGradient) {
  const AdamOptions options{.learning_rate = 0.01, .epsilon = 1e-15};
  const std::vector<double> gradient{3, -0.001};
  std::vector<double> p{1, 1}, m(2), v(2);
  for (int t = 1; t <= 20; ++t) AdamStep(options, t, 2, gradient.data(), p.data(), m.data(), v.data());
  EXPECT_NEAR(p[0], 1 - 0.2, 1e-12);
  EXPECT_NEAR(p[1], 1 + 0.2, 1e-12);
}

TEST(Adam, FollowsItsDefinitionInFloatAndDouble) {
  const int n = 40000;  // more than one thread's share
  const AdamOptions options{.learning_rate = 0.02, .beta1 = 0.9, .beta2 = 0.99, .epsilon = 1e-3};
  std::vector<double> p = Uniforms(n, -1, 1, 1), expected = p, m(n), v(n), m_expected(n), v_expected(n);
  std::vector<float> p_f(p.begin(), p.end()), m_f(n), v_f(n);
  for (int t = 1; t <= 3; ++t) {
    const auto gradient = Uniforms(n, -1, 1, 10 + t);
    const std::vector<float> gradient_f(gradient.begin(), gradient.end());
    AdamStep(options, t, n, gradient.data(), p.data(), m.data(), v.data());
    AdamStep(options, t, n, gradient_f.data(), p_f.data(), m_f.data(), v_f.data());
    for (int i = 0; i < n; ++i) {
      m_expected[i] = 0.9 * m_expected[i] + 0.1 * gradient[i];
      v_expected[i] = 0.99 * v_expected[i] + 0.01 * gradient[i] * gradient[i];
      const double m_hat = m_expected[i] / (1 - std::pow(0.9, t)), v_hat = v_expected[i] / (1 - std::pow(0.99, t));
      expected[i] -= 0.02 * m_hat / (std::sqrt(v_hat) + 1e-3);
    }
  }
  for (int i = 0; i < n; ++i) {
    ASSERT_NEAR(p[i], expected[i], 1e-13);
    ASSERT_NEAR(p_f[i], expected[i], 1e-5);
  }
}

TEST(Adam, LazyLeavesUntouchedBlocksAlone) {
  const AdamOptions options{.learning_rate = 0.1, .lazy = true};
  std::vector<float> gradient(48), p(48, 1), m(48, 0.5), v(48, 0.5);
  gradient[20] = 1;
  AdamStep(options, 5, 48, gradient.data(), p.data(), m.data(), v.data());
  for (int i = 0; i < 48; ++i) EXPECT_EQ(p[i] != 1 && m[i] != 0.5, i / 16 == 1) << i;
}

TEST(AllFinite, FindsOneBadNumberAnywhere) {
  const int n = 40000;
  std::vector<float> values(n, std::numeric_limits<float>::max());
  EXPECT_TRUE(AllFinite(values.data(), n));
  for (const int i : {0, 1, 16383, 16384, n - 1}) {
    for (const float bad : {NAN, INFINITY, -INFINITY}) {
      values[i] = bad;
      EXPECT_FALSE(AllFinite(values.data(), n)) << i;
      values[i] = 0;
    }
  }
}

}  // namespace
}  // namespace nrff
