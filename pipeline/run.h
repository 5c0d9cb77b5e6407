// Runs the branches of several captures as one graph and says what came of them.
#pragma once

#include <ostream>
#include <vector>

#include "pipeline/branches.h"
#include "pipeline/console.h"
#include "pipeline/local_executor.h"

namespace nrff {

struct BranchResult {
  BranchRequest request;
  struct Stage {
    Node node;
    Outcome outcome;
    std::optional<Manifest> manifest;  // when the artifact can be used
  };
  std::vector<Stage> stages;

  const Stage* Find(const std::string& stage) const;
  const Stage* FirstFailed() const;  // nullptr: none
};

// Runs the graph of these nodes; what happens is shown on stderr and recorded in the workspaces. Throws Error with exit
// code 128 + n when signal n stopped the run.
std::vector<BranchResult> RunBranches(const std::vector<BranchRequest>& requests, std::vector<Node> nodes,
                                      const Machine& machine, Verbosity verbosity);

// What ProbeExtension found, for people; empty where the capture is as it was.
std::string ExtensionText(const Json& extension);

// Asks the training program about the requests' options, claims and locks their workspaces, runs everything, and writes
// a report with the diagnosis for a capture that failed, unless a complete one would be lost. Throws as RunBranches,
// and what the training program or a workspace refuses before anything ran.
std::vector<BranchResult> RunRequests(const std::vector<BranchRequest>& requests, Verbosity verbosity);

// Throws the first failed branch's error, with its exit code.
void ThrowIfFailed(const std::vector<BranchResult>& results);

// Registered images, scores, seconds per stage and where the report is.
void PrintResult(const BranchResult& result, std::ostream& out);
Json ResultToJson(const BranchResult& result);

}  // namespace nrff
