#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>

#include "model/kernels/adam.h"
#include "model/kernels/simd.h"

namespace nrff {
namespace {

constexpr int64_t kLazyBlock = 16;
constexpr int64_t kThreadBlock = 16384;  // a multiple of kLazyBlock

// The step's constants in the scalar type of the work.
template <typename Scalar>
struct Coefficients {
  Scalar beta1, beta2, step_size, root_correction2, epsilon;
  bool lazy;

  Coefficients(const AdamOptions& options, int64_t t)
      : beta1(Scalar(options.beta1)),
        beta2(Scalar(options.beta2)),
        step_size(Scalar(options.learning_rate / (1 - std::pow(options.beta1, double(t))))),
        root_correction2(Scalar(1 / std::sqrt(1 - std::pow(options.beta2, double(t))))),
        epsilon(Scalar(options.epsilon)),
        lazy(options.lazy) {}
};

template <typename Scalar>
NRFF_INLINE void Update(const Coefficients<Scalar>& c, int64_t begin, int64_t end, const Scalar* g, Scalar* p,
                        Scalar* m, Scalar* v) {
  for (int64_t block = begin; block < end; block += kLazyBlock) {
    const int64_t block_end = std::min(end, block + kLazyBlock);
    if (c.lazy) {
      bool touched = false;
      for (int64_t i = block; i < block_end; ++i) touched |= g[i] != 0;
      if (!touched) continue;
    }
    for (int64_t i = block; i < block_end; ++i) {
      m[i] = c.beta1 * m[i] + (1 - c.beta1) * g[i];
      v[i] = c.beta2 * v[i] + (1 - c.beta2) * g[i] * g[i];
      p[i] -= c.step_size * m[i] / (std::sqrt(v[i]) * c.root_correction2 + c.epsilon);
    }
  }
}

NRFF_MULTIVERSION void UpdateBlock(const Coefficients<float>& c, int64_t begin, int64_t end, const float* g, float* p,
                                   float* m, float* v) {
  Update(c, begin, end, g, p, m, v);
}
void UpdateBlock(const Coefficients<double>& c, int64_t begin, int64_t end, const double* g, double* p, double* m,
                 double* v) {
  Update(c, begin, end, g, p, m, v);
}

// The exponent's bits are all set in infinities and NaN alone; integers, since a compiler may not reorder sums of
// floats.
template <typename Bits, typename Scalar>
NRFF_INLINE bool Finite(const Scalar* values, int64_t begin, int64_t end) {
  constexpr Bits kInfinity = std::bit_cast<Bits>(std::numeric_limits<Scalar>::infinity());
  Bits n_bad = 0;
  for (int64_t i = begin; i < end; ++i) n_bad |= (std::bit_cast<Bits>(values[i]) & kInfinity) == kInfinity;
  return n_bad == 0;
}
NRFF_MULTIVERSION bool FiniteBlock(const float* values, int64_t begin, int64_t end) {
  return Finite<uint32_t>(values, begin, end);
}
bool FiniteBlock(const double* values, int64_t begin, int64_t end) { return Finite<uint64_t>(values, begin, end); }

}  // namespace

template <typename Scalar>
void AdamStep(const AdamOptions& options, int64_t t, int64_t n, const Scalar* gradient, Scalar* parameters, Scalar* m,
              Scalar* v) {
  const Coefficients<Scalar> coefficients(options, t);
#pragma omp parallel for schedule(static) if (n > kThreadBlock)
  for (int64_t begin = 0; begin < n; begin += kThreadBlock) {
    UpdateBlock(coefficients, begin, std::min(n, begin + kThreadBlock), gradient, parameters, m, v);
  }
}

template <typename Scalar>
bool AllFinite(const Scalar* values, int64_t n) {
  bool finite = true;
#pragma omp parallel for schedule(static) reduction(&& : finite) if (n > kThreadBlock)
  for (int64_t begin = 0; begin < n; begin += kThreadBlock) {
    finite = finite && FiniteBlock(values, begin, std::min(n, begin + kThreadBlock));
  }
  return finite;
}

template void AdamStep(const AdamOptions&, int64_t, int64_t, const float*, float*, float*, float*);
template void AdamStep(const AdamOptions&, int64_t, int64_t, const double*, double*, double*, double*);
template bool AllFinite(const float*, int64_t);
template bool AllFinite(const double*, int64_t);

}  // namespace nrff
