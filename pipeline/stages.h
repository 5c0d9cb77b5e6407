// The stages: their order, their command lines, which options go to which, and what they need of the machine.
// A capture's branch of the graph is made here.
#pragma once

#include <filesystem>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "pipeline/graph.h"
#include "pipeline/scheduler.h"
#include "pipeline/workspace.h"

namespace nrff {

// In the order of the pipeline.
const std::vector<std::string>& StageNames();

struct BranchRequest {
  std::string name;  // of the branch
  Workspace workspace;
  std::filesystem::path capture;      // absolute
  std::filesystem::path executables;  // the folder of the stages' programs
  Params options;       // that change results, as given: preset, steps, budget, seed, device, max-image-size
  std::string threads;  // as given, or empty
  std::string from;     // this stage and what follows it runs again; empty: nothing for that reason
  std::string until;    // the last stage; empty: all
};

// Decisions that can be forced: the stage that makes them, its option, and the option's words for needed and not
// needed.
struct Forceable {
  const char *feature, *stage, *option, *needed, *left_out;
};
const std::vector<Forceable>& Forceables();

// The first node of the branch. It expands into the rest once the capture is known to bring its poses or not.
Node FirstNode(const BranchRequest& request, const Machine& machine);

// What of the stages that are done a run on the capture with photos added would take over. Empty unless ingest and sfm
// are done, of each other, by this version; a stage not made of these is left out, and so is what follows it.
KeptFiles ExtendableStages(const Workspace& workspace);
inline constexpr size_t kMostExtendable = 4;  // ingest to train

// The branch of an ended pipeline: `stages` run whatever they are, those before them are taken as they are. `posed`:
// what ingest found.
std::vector<Node> BranchToRunAgain(const BranchRequest& request, const Machine& machine, bool posed,
                                   const std::vector<std::string>& stages);

// The branch of a capture whose poses are taken as they are; what follows them runs where it is stale.
std::vector<Node> BranchOnPoses(const BranchRequest& request, const Machine& machine, bool posed);

// What the eval stage is told to measure LPIPS with: what was given, or DefaultLpipsNetwork(), or needs::kNoLpips.
std::string LpipsNetworkOf(const BranchRequest& request);

// All options of stages that can be in BranchRequest::options.
std::set<std::string> StageOptions();

// The training program with the options that it would be given.
std::vector<std::string> TrainingOptions(const BranchRequest& request);

// Where the program that is running lies.
std::filesystem::path ExecutableFolder();

}  // namespace nrff
