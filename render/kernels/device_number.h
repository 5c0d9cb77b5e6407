// Numbers of 16 bits as GPUs store them: bf16 (8 bits of precision, float's range) and half (11 bits, up to 65504).
// Rounded to nearest, ties to even. In C++ without CUDA they are emulated bit by bit.
#pragma once

#include <cstdint>
#include <cstring>

#include "render/kernels/device.h"

#if defined(__CUDACC__)
#include <cuda_bf16.h>
#include <cuda_fp16.h>
#endif

namespace nrff {

#if defined(__CUDACC__)

using Bf16 = __nv_bfloat16;
using Half = __half;

NRFF_HOST_DEVICE inline float ToFloat(Bf16 x) { return __bfloat162float(x); }
NRFF_HOST_DEVICE inline float ToFloat(Half x) { return __half2float(x); }
NRFF_HOST_DEVICE inline void FromFloat(float x, Bf16& to) { to = __float2bfloat16(x); }
NRFF_HOST_DEVICE inline void FromFloat(float x, Half& to) { to = __float2half(x); }

#else

struct Bf16 {
  uint16_t bits;
};
struct Half {
  uint16_t bits;
};

inline uint32_t BitsOf(float x) {
  uint32_t bits;
  std::memcpy(&bits, &x, sizeof(bits));
  return bits;
}
inline float FloatOf(uint32_t bits) {
  float value;
  std::memcpy(&value, &bits, sizeof(value));
  return value;
}

inline float ToFloat(Bf16 x) { return FloatOf(static_cast<uint32_t>(x.bits) << 16); }
inline void FromFloat(float x, Bf16& to) {
  const uint32_t bits = BitsOf(x);
  const bool is_nan = (bits & 0x7fffffff) > 0x7f800000;
  const uint32_t rounded = bits + 0x7fff + ((bits >> 16) & 1);
  to.bits = is_nan ? uint16_t{0x7fff} : static_cast<uint16_t>(rounded >> 16);
}

inline float ToFloat(Half x) {
  const uint32_t sign = static_cast<uint32_t>(x.bits & 0x8000) << 16, exponent = (x.bits >> 10) & 31;
  const uint32_t fraction = x.bits & 0x3ff;
  if (exponent == 0) {  // denormal
    const float value = static_cast<float>(fraction) * 0x1p-24F;
    return sign != 0 ? -value : value;
  }
  return FloatOf(sign | ((exponent == 31 ? 255 : exponent + 112) << 23) | (fraction << 13));
}
inline void FromFloat(float x, Half& to) {
  const uint32_t bits = BitsOf(x), sign = (bits >> 16) & 0x8000, magnitude = bits & 0x7fffffff;
  uint32_t half;
  if (magnitude > 0x7f800000) {
    half = 0x7e00;  // NaN
  } else if (magnitude >= 0x477ff000) {
    half = 0x7c00;  // 65520 and more round to infinity
  } else if (magnitude < 0x38800000) {
    // Below 2⁻¹⁴: adding ½ rounds to multiples of 2⁻²⁴.
    half = BitsOf(FloatOf(magnitude) + 0.5F) - BitsOf(0.5F);
  } else {
    half = (magnitude + 0xfff + ((magnitude >> 13) & 1) - 0x38000000) >> 13;
  }
  to.bits = static_cast<uint16_t>(sign | half);
}

#endif

NRFF_HOST_DEVICE inline float ToFloat(float x) { return x; }
NRFF_HOST_DEVICE inline void FromFloat(float x, float& to) { to = x; }

}  // namespace nrff
