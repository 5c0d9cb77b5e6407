// Elementary functions that compilers turn into vector code inside a loop. float: polynomials, within 2 ulp where the
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

// 1/x within 1e-7 of it, for normal x > 0: three of Newton's steps, which are faster than a division of vectors.
NRFF_INLINE float FastInverse(float x) {
  float y = std::bit_cast<float>(0x7EF311C7 - std::bit_cast<int32_t>(x));
  for (int step = 0; step < 3; ++step) y = y * (2 - x * y);
  return y;
}

// x · Φ(x), Φ the standard normal distribution function, and the derivative Φ(x) + x φ(x). Φ is within 2.5e-7:
// Abramowitz and Stegun 7.1.26 (half of its 1.5e-7) and the rounding of its polynomial, whose terms reach 1.5.
NRFF_INLINE void FastGelu(float x, float& gelu, float& derivative) {
  constexpr float kInverseRoot2Pi = 0.398942280F;
  const float a = (x > 0 ? x : -x) * 0.707106781F;
  const float t = FastInverse(1 + 0.3275911F * a);
  float p = 1.061405429F;
  p = p * t - 1.453152027F;
  p = p * t + 1.421413741F;
  p = p * t - 0.284496736F;
  p = p * t + 0.254829592F;
  const float gaussian = FastExp(-a * a);
  const float tail = 0.5F * p * t * gaussian;
  const float cdf = x > 0 ? 1 - tail : tail;
  gelu = x * cdf;
  derivative = cdf + x * kInverseRoot2Pi * gaussian;
}

}  // namespace nrff
