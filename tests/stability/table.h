// The stability table: every case with its error, the bound that follows from the number format, and the margin.
#pragma once

#include <limits>
#include <string>

namespace nrff::stability {

// Unit roundoff: the largest relative error of rounding to nearest.
template <typename Scalar>
inline constexpr double kUnit = double(std::numeric_limits<Scalar>::epsilon()) / 2;

template <typename Scalar>
inline constexpr const char* kFormat = sizeof(Scalar) == sizeof(float) ? "float" : "double";

// Fails the test unless error ≤ bound (a NaN is not), and appends the case as a line of JSON {part, name, condition,
// error, bound} to the file that NRFF_STABILITY_TABLE names, if it does.
void Hold(const std::string& part, const std::string& name, const std::string& condition, double error, double bound);

// The worst of many comparisons: the one with the largest share of its own bound.
class Worst {
 public:
  void Add(double error, double bound);
  // As Hold; of nothing added, fails.
  void Hold(const std::string& part, const std::string& name, const std::string& condition) const;

 private:
  double error_ = 0, bound_ = 0, share_ = -1;
};

}  // namespace nrff::stability
