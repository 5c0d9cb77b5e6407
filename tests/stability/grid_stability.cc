// The feature grids in float against themselves in double on the same numbers, at and beyond their ends, and against
// laws that need no second computation.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>
#include <vector>

#include "model/kernels/feature_grid.h"
#include "tests/stability/table.h"
#include "tests/uniforms.h"

namespace nrff::stability {
namespace {

constexpr float kInfinity = std::numeric_limits<float>::infinity();

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

// Features are linear in the planes and in the lines, so that both parts of the gradient, times their parameters, sum
// to what the features themselves sum to. The bound is the gradient's own (above), times |p|, and the features'.
template <typename Scalar>
void HoldAdjoint() {
  const GridLayout layout = MakeGridLayout(3, 4, 64, 4);
  const auto parameters = Converted<Scalar>(Uniforms(layout.n_parameters, -1, 1, 7));
  const auto points = Converted<float>(Uniforms(3 * 2000, -1.1, 1.1, 8));
  const auto at = Converted<Scalar>(points);
  const auto n = int64_t(points.size() / 3);
  const auto weights = Converted<Scalar>(Uniforms(layout.n_features() * n, -1, 1, 9));
  std::vector<Scalar> size_parameters = parameters, size_weights = weights;
  for (Scalar& value : size_parameters) value = std::abs(value);
  for (Scalar& value : size_weights) value = std::abs(value);
  const auto features = Concat(layout, parameters, at);
  const std::vector<int> beside = PointsBeside(layout, points);
  Worst worst;
  for (int p = 0; p < layout.n_products(); ++p) {
    const int64_t first = p * n * 4;
    std::vector<Scalar> gradient(layout.n_parameters, 0), size(layout.n_parameters, 0);
    GridConcatBackward(layout, p, parameters.data(), at.data(), n, weights.data() + first, gradient.data());
    GridConcatBackward(layout, p, size_parameters.data(), at.data(), n, size_weights.data() + first, size.data());
    double sum = 0;
    for (int64_t i = first; i < first + n * 4; ++i) sum += double(weights[i]) * features[i];
    const GridLayout::Level& level = layout.levels[p / 3];
    const int64_t resolution = level.resolution;
    const auto hold_part = [&](int64_t begin, int64_t end) {
      double of_gradient = 0, bound = 0;
      for (int64_t i = begin; i < end; ++i) {
        of_gradient += double(parameters[i]) * gradient[i];
        bound += std::abs(double(parameters[i])) * size[i] * (beside[i / layout.n_channels] + 64);
      }
      worst.Add(std::abs(of_gradient - sum), bound * kUnit<Scalar>);
    };
    hold_part(level.plane_offsets[p % 3], level.plane_offsets[p % 3] + resolution * resolution * layout.n_channels);
    hold_part(level.line_offsets[p % 3], level.line_offsets[p % 3] + resolution * layout.n_channels);
  }
  worst.Hold("grid", "⟨Jᵀw, p⟩ − ⟨w, f⟩, planes and lines", kFormat<Scalar>);
}

TEST(Grid, BackwardIsTheAdjointOfForward) {
  HoldAdjoint<float>();
  HoldAdjoint<double>();
}

// A grid of 2n − 1 nodes whose new nodes lie halfway holds the same function. Values are multiples of 1/1024, so that
// means of two and four are exact; a coordinate's place is off by 2u of the last node, through values that change by 2
// at most, as above.
template <typename Scalar>
void HoldUpsampling() {
  Worst worst;
  for (const int n : {2, 33, 257}) {
    const int fine_n = 2 * n - 1;
    const GridLayout coarse = MakeGridLayout(1, n, n, 4), fine = MakeGridLayout(1, fine_n, fine_n, 4);
    std::vector<Scalar> values = Converted<Scalar>(Uniforms(coarse.n_parameters, -1024, 1024, 10));
    for (Scalar& value : values) value = std::round(value) / 1024;
    std::vector<Scalar> fine_values(fine.n_parameters);
    for (int p = 0; p < 3; ++p) {
      for (int c = 0; c < 4; ++c) {
        const auto line = [&](int i) { return values[coarse.levels[0].line_offsets[p] + 4 * i + c]; };
        const auto plane = [&](int i, int j) {
          return values[coarse.levels[0].plane_offsets[p] + 4 * (int64_t(i) * n + j) + c];
        };
        for (int i = 0; i < fine_n; ++i) {
          const int below = i / 2, above = (i + 1) / 2;
          fine_values[fine.levels[0].line_offsets[p] + 4 * i + c] = (line(below) + line(above)) / 2;
          for (int j = 0; j < fine_n; ++j) {
            fine_values[fine.levels[0].plane_offsets[p] + 4 * (int64_t(i) * fine_n + j) + c] =
                (plane(below, j / 2) + plane(below, (j + 1) / 2) + plane(above, j / 2) + plane(above, (j + 1) / 2)) / 4;
          }
        }
      }
    }
    const auto points = Converted<Scalar>(Uniforms(3 * 1000, -1, 1, 11));
    const auto before = Concat(coarse, values, points), after = Concat(fine, fine_values, points);
    for (size_t i = 0; i < before.size(); ++i) {
      worst.Add(std::abs(double(before[i]) - after[i]), (12. * (n - 1) + 12. * (fine_n - 1) + 32) * kUnit<Scalar>);
    }
  }
  worst.Hold("grid", "features after upsampling n → 2n − 1", std::string(kFormat<Scalar>) + ", n 2 to 257");
}

TEST(Grid, UpsamplingKeepsTheFunction) {
  HoldUpsampling<float>();
  HoldUpsampling<double>();
}

}  // namespace
}  // namespace nrff::stability
