// Numbers for tests: the same on every machine.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "render/kernels/random.h"

namespace nrff {

inline std::vector<double> Uniforms(size_t n, double low, double high, uint64_t stream) {
  std::vector<double> values(n);
  for (size_t i = 0; i < n; ++i) values[i] = low + (high - low) * double(Uniform(1, stream, i));
  return values;
}

template <typename To, typename From>
std::vector<To> Converted(const std::vector<From>& values) {
  return {values.begin(), values.end()};
}

}  // namespace nrff
