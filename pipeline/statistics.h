// Order statistics of a few numbers.
#pragma once

#include <algorithm>
#include <limits>
#include <vector>

namespace nrff {

// Of an even number, the greater of the middle two; NaN of none.
inline double Median(std::vector<double> values) {
  if (values.empty()) return std::numeric_limits<double>::quiet_NaN();
  const auto middle = values.begin() + long(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

}  // namespace nrff
