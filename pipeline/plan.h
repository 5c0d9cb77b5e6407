// What a run would do, and why, before it does it.
#pragma once

#include <optional>
#include <ostream>
#include <string>
#include <vector>

#include "pipeline/branches.h"
#include "pipeline/executor.h"
#include "pipeline/json.h"

namespace nrff {

struct BranchPlan {
  BranchRequest request;
  Json facts = Json::object();      // what ingest found, or says it will
  Json extension = Json::object();  // ProbeExtension
  Json training = Json::object();   // what the options mean to training: ProbeTraining
  std::vector<Node> nodes = {};
  std::vector<Verdict> verdicts = {};       // by node
  std::vector<Decision> decisions = {};     // what is known now, or was forced
  std::vector<std::string> undecided = {};  // features that stages will decide on
  int exit_code = 0;                        // of what kept the plan from being made
  std::string error = {};
};

// Nothing is written. What cannot be planned says so in `error`.
BranchPlan PlanBranch(const BranchRequest& request, Executor& executor);

// `explained`: with all decisions as a table (plan_table.h) of so many columns; else what is left out alone, a line
// each.
void PrintPlans(const std::vector<BranchPlan>& plans, std::optional<int> explained, std::ostream& out);
Json PlansToJson(const std::vector<BranchPlan>& plans);

// Plans and prints. Throws the first plan's error when one cannot be made.
void PlanAndPrint(const std::vector<BranchRequest>& requests, bool json, bool explain = false);

}  // namespace nrff
