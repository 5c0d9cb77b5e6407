#include "tests/stability/table.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstdlib>
#include <fstream>

#include "pipeline/json.h"

namespace nrff::stability {

void Hold(const std::string& part, const std::string& name, const std::string& condition, double error, double bound) {
  EXPECT_LE(error, bound) << part << ": " << name << ", " << condition;
  const char* file = std::getenv("NRFF_STABILITY_TABLE");
  if (file == nullptr) return;
  const Json row = {{"part", part}, {"name", name}, {"condition", condition}, {"error", error}, {"bound", bound}};
  std::ofstream(file, std::ios::app) << row.dump() << '\n';
}

void Worst::Add(double error, double bound) {
  const double share = error <= bound ? (bound > 0 ? error / bound : 0) : std::isnan(error) ? HUGE_VAL : error / bound;
  if (share <= share_) return;
  share_ = share;
  error_ = error;
  bound_ = bound;
}

void Worst::Hold(const std::string& part, const std::string& name, const std::string& condition) const {
  ASSERT_GE(share_, 0) << "nothing was compared: " << name;
  stability::Hold(part, name, condition, error_, bound_);
}

}  // namespace nrff::stability
