// Laws of what a tile of samples is made of: matrix products, transposes, features as rows.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

#include "model/kernels/fast_math.h"
#include "model/kernels/tile_gemm.h"
#include "model/kernels/tile_gemm_bf16.h"
#include "model/kernels/tile_rows.h"
#include "tests/uniforms.h"

namespace nrff {
namespace {

// All sizes around the kernels' blocks, both orders of A, all starts; elements beyond C's columns stay.
TEST(TileGemm, IsTheProductWhateverTheSizes) {
  for (const int64_t m : {1, 3, 11, 16, 49}) {
    for (const int64_t n : {16, 48, 64, 112}) {
      for (const int64_t k : {1, 17, 160, 545, 548}) {
        for (const auto& [start, precision] : {std::pair{GemmStart::kZero, GemmPrecision::kFloat},
                                               {GemmStart::kBias, GemmPrecision::kFloat},
                                               {GemmStart::kBias, GemmPrecision::kBf16},
                                               {GemmStart::kSum, GemmPrecision::kFloat}}) {
          const bool transposed = (m + k) % 2 == 0,
                     b_transposed = k % 4 == 0 && m > 3 && precision == GemmPrecision::kFloat;
          const int64_t b_row = (b_transposed ? k : n) + 5;
          const auto a = Uniforms(m * k, -1, 1, 1), b = Uniforms((k + n) * b_row, -1, 1, 2),
                     bias = Uniforms(m, -1, 1, 3), c = Uniforms(m * (n + 3), -1, 1, 4);
          const std::vector<float> af(a.begin(), a.end()), bf(b.begin(), b.end()), biasf(bias.begin(), bias.end());
          std::vector<float> cf(c.begin(), c.end()), scratch(k * (n + 16));
          const GemmArgs args{.m = m,
                              .n = n,
                              .k = k,
                              .a = af.data(),
                              .a_row = transposed ? 1 : k,
                              .a_column = transposed ? m : 1,
                              .b = bf.data(),
                              .b_row = b_row,
                              .c = cf.data(),
                              .c_row = n + 3,
                              .start = start,
                              .bias = biasf.data(),
                              .precision = precision};
          if (b_transposed) {
            TileGemmTransposed(args, {scratch.data(), n + 16});
          } else {
            TileGemm(args);
          }
          for (int64_t i = 0; i < m; ++i) {
            for (int64_t j = 0; j < n + 3; ++j) {
              double expected = start == GemmStart::kSum ? c[i * (n + 3) + j] : start == GemmStart::kBias ? bias[i] : 0;
              double magnitude = 0;
              for (int64_t l = 0; l < k; ++l) {
                const double product =
                    a[transposed ? l * m + i : i * k + l] * b[b_transposed ? j * b_row + l : l * b_row + j];
                expected += product;
                magnitude += std::abs(product);
              }
              if (j >= n) expected = c[i * (n + 3) + j];
              // k products, each rounded once, of numbers below 1; operands split in two bf16, or rounded to one, where
              // the processor multiplies those.
              const double split = !Bf16Pays(args)                      ? 0
                                   : precision == GemmPrecision::kFloat ? 3 * std::ldexp(magnitude, -18)
                                                                        : 2.01 * std::ldexp(magnitude, -9);
              ASSERT_NEAR(cf[i * (n + 3) + j], expected, 6e-8 * double(k + 2) * 2 + split) << m << " " << n << " " << k;
            }
          }
        }
      }
    }
  }
}

// A product of 49 × 112 sums of k products; rows of C are three floats longer.
struct Product {
  static constexpr int64_t kM = 49, kN = 112, kRow = kN + 3;

  explicit Product(int64_t k) : k_(k), a_(Floats(kM * k, 1)), b_(Floats(k * kN, 2)) {}

  static std::vector<float> Floats(int64_t n, uint64_t seed) {
    const auto values = Uniforms(n, -1, 1, seed);
    return {values.begin(), values.end()};
  }

  GemmArgs Into(std::vector<float>& c) const {
    return {.m = kM,
            .n = kN,
            .k = k_,
            .a = a_.data(),
            .a_row = k_,
            .a_column = 1,
            .b = b_.data(),
            .b_row = kN,
            .c = c.data(),
            .c_row = kRow};
  }

 private:
  int64_t k_;
  std::vector<float> a_, b_;
};

TEST(TileGemm, AnActivationIsThatOfTheSumAndHasItsDerivative) {
  for (const int64_t k : {17, 545}) {
    const Product product(k);
    std::vector<float> sum(Product::kM * Product::kRow, 7.F);
    TileGemm(product.Into(sum));
    for (const Activation activation : {Activation::kGelu, Activation::kRelu}) {
      for (const bool with_derivative : {true, false}) {
        std::vector<float> after(sum.size(), 7.F), derivative(sum.size(), 7.F);
        GemmArgs args = product.Into(after);
        args.activation = activation;
        args.derivative = with_derivative ? derivative.data() : nullptr;
        TileGemm(args);
        for (size_t at = 0; at < sum.size(); ++at) {
          float expected = sum[at] > 0 ? sum[at] : 0, slope = sum[at] > 0 ? 1 : 0;
          if (activation == Activation::kGelu) FastGelu(sum[at], expected, slope);
          if (at % Product::kRow >= Product::kN) expected = slope = 7;
          ASSERT_NEAR(after[at], expected, 1e-6 * std::max(1.F, std::abs(expected)));
          ASSERT_NEAR(derivative[at], with_derivative ? slope : 7, 1e-6);
        }
      }
    }
  }
}

TEST(TileGemm, AFactorScalesTheSum) {
  for (const int64_t k : {17, 545}) {
    const Product product(k);
    std::vector<float> sum(Product::kM * Product::kRow, 7.F), scaled = sum;
    const std::vector<float> factor = Product::Floats(Product::kM * Product::kRow, 3);
    TileGemm(product.Into(sum));
    GemmArgs args = product.Into(scaled);
    args.factor = factor.data();
    TileGemm(args);
    for (size_t at = 0; at < sum.size(); ++at) {
      const float expected = at % Product::kRow >= Product::kN ? 7 : sum[at] * factor[at];
      ASSERT_NEAR(scaled[at], expected, 1e-6 * std::max(1.F, std::abs(sum[at])));
    }
  }
}

TEST(TileTranspose, TwiceIsTheMatrixItself) {
  const auto values = Uniforms(12 * 20, -1, 1, 1);
  const std::vector<float> from(values.begin(), values.end());
  std::vector<float> across(16 * 14), back(12 * 20);
  TileTranspose(from.data(), 20, 12, 16, across.data(), 14);
  EXPECT_EQ(across[3 * 14 + 7], from[7 * 20 + 3]);
  TileTranspose(across.data(), 14, 16, 12, back.data(), 20);
  for (int i = 0; i < 12; ++i) {
    for (int j = 0; j < 16; ++j) ASSERT_EQ(back[i * 20 + j], from[i * 20 + j]);
  }
}

TEST(TileRows, ProductsGoToRowsAndBack) {
  for (const int channels : {2, 4}) {
    const GridLayout layout = MakeGridLayout(2, 4, 8, channels);
    const auto values = Uniforms(layout.n_features() * 19, 1, 2, 1);
    const std::vector<float> features(values.begin(), values.end());
    std::vector<float> rows(layout.n_features() * 40, 9.F), back(features.size());
    ProductsToRows(features.data(), layout, 19, 40, rows.data());
    EXPECT_EQ(rows[(4 * channels + 1) * 40 + 18], features[(4 * 19 + 18) * channels + 1]);
    EXPECT_EQ(rows[31], 0);  // padding to whole vectors
    EXPECT_EQ(rows[32], 9);
    RowsToProducts(rows.data(), layout, 19, 40, back.data());
    EXPECT_EQ(back, features);
  }
}

TEST(TileRows, SpansAreWeightedMeansAndOneSampleIsItself) {
  for (const int channels : {2, 4}) {
    const GridLayout layout = MakeGridLayout(2, 4, 8, channels);
    const auto values = Uniforms(layout.n_features() * 7, 1, 2, 1);
    const std::vector<float> features(values.begin(), values.end());
    const float weights[7] = {0.1F, 0.3F, 0.5F, 1e-4F, 0.7F, 0.2F, 0.9F};
    const int64_t begins[2] = {3, 4}, ends[2] = {4, 7};
    std::vector<float> rows(layout.n_features() * 16, 9.F);
    MeansToRows(
        {.n_samples = 7, .features = features.data(), .weights = weights, .n_spans = 2, .begins = begins, .ends = ends},
        layout, 16, rows.data());
    for (int p = 0; p < layout.n_products(); ++p) {
      for (int c = 0; c < channels; ++c) {
        const float* row = &rows[(p * channels + c) * 16];
        const auto at = [&](int64_t i) { return double(features[(p * 7 + i) * channels + c]); };
        ASSERT_EQ(row[0], float(at(3)));
        double sum = 0, weight = 0;
        for (int64_t i = 4; i < 7; ++i) {
          sum += double(weights[i]) * at(i);
          weight += double(weights[i]);
        }
        ASSERT_NEAR(row[1], sum / weight, 2e-6);  // values to 2, a few roundings
        ASSERT_EQ(row[2], 0);                     // padding
      }
    }
  }
}

}  // namespace
}  // namespace nrff
