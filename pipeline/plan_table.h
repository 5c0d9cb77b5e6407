// The table of `nrff plan --explain`: every decision of a plan, by what it was made, and what is decided later.
#pragma once

#include <string>

#include "pipeline/plan.h"

namespace nrff {

// No line is longer than `columns` characters (60 at the least), words that are themselves longer apart; ends with a
// newline. Features that --need and --leave-out take are marked by a star.
std::string DecisionTable(const BranchPlan& plan, int columns);

}  // namespace nrff
