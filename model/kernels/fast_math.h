// Elementary functions that compilers turn into vector code inside a loop, the same on a GPU. float: polynomials, within 2 ulp where the
// result is a normal number; double: the standard library's.
#pragma once

#include <bit>
#include <cmath>
#include <cstdint>

#include "model/kernels/simd.h"

namespace nrff {

// e^x, with x taken into [−87, 88]; NaN stays NaN.
NRFF_INLINE float FastExp(float x) {
  x = x < -87.f ? -87.f : x;
  x = x > 88.f ? 88.f : x;
  constexpr float kRound = 12582912.f;  // 1.5·2²³: adding it rounds to an integer, in the low bits
  const float shifted = x * 1.44269504f + kRound;
  const float k = shifted - kRound;
  const float r = (x - k * 0.693359375f) + k * 2.12194440e-4f;  // ln 2 in two parts
  float p = 1.f / 5040;
  p = p * r + 1.f / 720;
  p = p * r + 1.f / 120;
  p = p * r + 1.f / 24;
  p = p * r + 1.f / 6;
  p = p * r + 0.5f;
  p = p * r + 1.f;
  p = p * r + 1.f;
  const int32_t exponent = std::bit_cast<int32_t>(shifted) - std::bit_cast<int32_t>(kRound);
  return p * std::bit_cast<float>((exponent + 127) << 23);
}
NRFF_INLINE double FastExp(double x) { return std::exp(x); }

// log(1 + x) for x in [0, 1].
NRFF_INLINE float FastLog1p(float x) {
  const float s = x / (2 + x);  // log(1 + x) = 2 artanh(s)
  const float s2 = s * s;
  float p = 1.f / 13;
  p = p * s2 + 1.f / 11;
  p = p * s2 + 1.f / 9;
  p = p * s2 + 1.f / 7;
  p = p * s2 + 1.f / 5;
  p = p * s2 + 1.f / 3;
  return 2 * s + 2 * s * s2 * p;
}
NRFF_INLINE double FastLog1p(double x) { return std::log1p(x); }

// softplus(x) = log(1 + e^x) and its derivative, the logistic function.
template <typename Scalar>
NRFF_INLINE void FastSoftplus(Scalar x, Scalar& softplus, Scalar& derivative) {
  const Scalar e = FastExp(x > 0 ? -x : x);
  const Scalar positive = x > 0 ? x : Scalar(0);
  softplus = positive + FastLog1p(e);
  const Scalar numerator = x > 0 ? Scalar(1) : e;
  derivative = numerator / (1 + e);
}

// 1 / (1 + e^−x)
NRFF_INLINE float FastSigmoid(float x) {
  const float e = FastExp(x > 0 ? -x : x);
  return (x > 0 ? 1.F : e) / (1 + e);
}

// x · Φ(x), Φ the standard normal distribution function, and the derivative Φ(x) + x φ(x). Φ is within 2.5e-7; gelu of
// NaN is NaN. The polynomials are minimax fits by Lawson's iteration.
NRFF_INLINE void FastGelu(float x, float& gelu, float& derivative) {
  constexpr float kInverseRoot2Pi = 0.398942280F;
  // By bits, as compilers make detours of comparisons.
  constexpr uint32_t kSign = 0x80000000;
  constexpr int32_t kFar = 0x41400000;  // 12, beyond which Φ(−a) counts as 0
  const auto bits = std::bit_cast<uint32_t>(x), sign = bits & kSign;
  const auto magnitude = int32_t(bits & ~kSign);
  const auto a_bits = uint32_t(magnitude < kFar ? magnitude : kFar);
  const auto a = std::bit_cast<float>(a_bits);
  // e^(−a²/2) = 2^k · 2^f, |f| ≤ ½; 2^f within 7.5e-8 of itself.
  constexpr float kRound = 12582912.F;
  const float exponent = a * (a * -0.721347520F);
  const float shifted = exponent + kRound;
  const float f = exponent - (shifted - kRound);
  float power = 1.32764073e-3F;
  power = power * f + 9.67554096e-3F;
  power = power * f + 5.55071346e-2F;
  power = power * f + 2.40221202e-1F;
  power = power * f + 6.93146944e-1F;
  power = power * f + 1.00000012F;
  const float gaussian =
      std::bit_cast<float>(std::bit_cast<uint32_t>(power) + (std::bit_cast<uint32_t>(shifted) << 23));
  // Φ(−a) e^(a²/2), such that its error times the Gaussian is within 7e-8 on [0, 6]; beyond, the Gaussian is nothing.
  float ratio = 1.63169318e-6F;
  ratio = ratio * a - 3.52078423e-5F;
  ratio = ratio * a + 3.39738879e-4F;
  ratio = ratio * a - 1.97462924e-3F;
  ratio = ratio * a + 7.93939456e-3F;
  ratio = ratio * a - 2.43139360e-2F;
  ratio = ratio * a + 6.11548908e-2F;
  ratio = ratio * a - 1.32513806e-1F;
  ratio = ratio * a + 2.49916792e-1F;
  ratio = ratio * a - 3.98936510e-1F;
  ratio = ratio * a + 4.99999940e-1F;
  const float beyond_half = 0.5F - ratio * gaussian;
  const float cdf = 0.5F + std::bit_cast<float>(std::bit_cast<uint32_t>(beyond_half) | sign);
  gelu = x * cdf;
  derivative = cdf + std::bit_cast<float>(a_bits | sign) * (kInverseRoot2Pi * gaussian);
}

}  // namespace nrff
