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

inline float ToFloat(Bf16 x) {
  const uint32_t bits = static_cast<uint32_t>(x.bits) << 16;
  float value;
  std::memcpy(&value, &bits, sizeof(value));
  return value;
}
inline void FromFloat(float x, Bf16& to) {
  uint32_t bits;
  std::memcpy(&bits, &x, sizeof(bits));
  const bool is_nan = (bits & 0x7fffffff) > 0x7f800000;
  const uint32_t rounded = bits + 0x7fff + ((bits >> 16) & 1);
  to.bits = is_nan ? uint16_t{0x7fff} : static_cast<uint16_t>(rounded >> 16);
}
inline float ToFloat(Half x) {
  _Float16 value;
  std::memcpy(&value, &x.bits, sizeof(value));
  return static_cast<float>(value);
}
inline void FromFloat(float x, Half& to) {
  const auto value = static_cast<_Float16>(x);
  std::memcpy(&to.bits, &value, sizeof(value));
}

#endif

NRFF_HOST_DEVICE inline float ToFloat(float x) { return x; }
NRFF_HOST_DEVICE inline void FromFloat(float x, float& to) { to = x; }

}  // namespace nrff
