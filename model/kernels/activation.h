// Activation functions of the networks' hidden layers.
#pragma once

#include <cstdint>

#include "model/kernels/fast_math.h"
#include "model/kernels/simd.h"

namespace nrff {

enum class Activation { kGelu, kRelu };  // GELU by erf, as the authors' code; the paper says ReLU

// row [n] → its activation, in place. derivative [n], or null: of the activation.
void ActivateRow(Activation activation, int64_t n, float* row, float* derivative);

// The same for a function that is compiled for the processor it runs on.
NRFF_INLINE void ActivateInline(Activation activation, int64_t n, float* row, float* derivative) {
  if (activation == Activation::kRelu) {
    for (int64_t s = 0; s < n; ++s) {
      const float x = row[s];
      row[s] = x < 0 ? 0.F : x;  // NaN stays
      if (derivative != nullptr) derivative[s] = x > 0 ? 1.F : 0.F;
    }
  } else if (derivative != nullptr) {
#pragma GCC ivdep
    for (int64_t s = 0; s < n; ++s) FastGelu(row[s], row[s], derivative[s]);
  } else {
    for (int64_t s = 0; s < n; ++s) {
      float unused;
      FastGelu(row[s], row[s], unused);
    }
  }
}

}  // namespace nrff
