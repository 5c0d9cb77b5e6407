// Adam [Kingma15] over a flat buffer, in one pass.
//
//   m ← β₁ m + (1 − β₁) g,  v ← β₂ v + (1 − β₂) g²,
//   p ← p − lr / (1 − β₁ᵗ) · m / (√v / √(1 − β₂ᵗ) + ε)
//
// Elementwise, so the result does not depend on the number of threads.
#pragma once

#include <cstdint>

namespace nrff {

struct AdamOptions {
  double learning_rate = 1e-3;
  double beta1 = 0.9, beta2 = 0.99;
  double epsilon = 1e-8;
  // Blocks of 16 elements whose gradient is zero throughout are left as they are: a batch touches few nodes of a fine
  // grid, and a node nobody looked at keeps its value and moments. Not what Adam does by the letter.
  bool lazy = false;
};

// t ≥ 1 counts steps. gradient, parameters, m, v [n]; m and v start at zero. Scalar is float or double.
template <typename Scalar>
void AdamStep(const AdamOptions& options, int64_t t, int64_t n, const Scalar* gradient, Scalar* parameters, Scalar* m,
              Scalar* v);

// Whether all of values [n] are finite.
template <typename Scalar>
bool AllFinite(const Scalar* values, int64_t n);

}  // namespace nrff
