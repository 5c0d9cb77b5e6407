// From what is given on the command line (captures, workspaces, options) to the branches of the graph.
#pragma once

#include <CLI/CLI.hpp>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/executor.h"
#include "pipeline/json.h"
#include "pipeline/stages.h"

namespace nrff {

// The options of `nrff run` and `nrff plan` that say what is to be made.
struct BranchOptions {
  std::vector<std::string> targets;  // captures or workspaces
  std::string workspace, budget, preset, set, directional, steps, frames, masks, camera_model, max_image_size,
      bit_depth, lpips, device, threads, seed, from;
  std::string until;
  std::vector<std::string> need, leave_out;  // features whose decision is forced
  bool force = false;
  // Of the command, not given on its line.
  bool in_folder = false;  // `workspace` holds the workspaces, even where there is one
  std::string folder = "work";
  Params defaults = {};  // what stages are told where nothing else is given
};
void AddTargetOption(CLI::App& command, BranchOptions& options);
void AddBranchOptions(CLI::App& command, BranchOptions& options);
// A line for the foot of their help.
inline constexpr char kFeaturesHelp[] =
    "FEATURE: exhaustive_matching gps_pairs second_attempt refinement undistortion\n  own_focal_lengths contraction "
    "sparse_depth fine_levels exposure_correction\n  camera_correction\n";

// One request per target. A target that is a workspace stands for its capture with the options of its last run, where
// none are given now. Nothing is written. Throws UsageError, InputError.
std::vector<BranchRequest> MakeBranches(const BranchOptions& options);

// What --need and --leave-out say of a feature; nothing where they do not name it.
std::optional<bool> ForcedDecision(const BranchRequest& request, const std::string& feature);

// The JSON object that a stage's program prints. Throws Error with the program's own sentence and exit code.
Json JsonFrom(Executor& executor, std::vector<std::string> command);

// What ingest says of a capture without making anything: {"kind", "posed", "n_images", …}. Throws Error with ingest's
// own sentence and exit code.
Json ProbeCapture(Executor& executor, const BranchRequest& request);

// Whether photos were added to the capture since the workspace's stages were made, and nothing else changed that they
// depend on: {"extension": {"n_earlier", "n_added"} or null, "why_anew": why it is null, or null}, both null where the
// capture is as it was, or everything is asked to run again. Nothing is written. Throws as ProbeCapture.
Json ProbeExtension(Executor& executor, const BranchRequest& request);

// What the options mean to the training program, which is the one that knows presets, settings and devices (nrff-train
// --probe): {"preset", "device", "steps", "budget_seconds", "decisions", …}. Throws Error with that program's own
// sentence and exit code.
Json ProbeTraining(Executor& executor, const BranchRequest& request);

// Features whose decision --need and --leave-out can force and one of these nodes makes, in the order of the pipeline.
std::vector<std::string> ForceableFeatures(const std::vector<Node>& nodes);

// The folder that all these workspaces lie in. Throws UsageError when they lie in several.
std::filesystem::path CommonFolder(const std::vector<Workspace>& workspaces);

// A branch for what is already in a workspace, with the options of its last run.
BranchRequest BranchOf(const Workspace& workspace);

}  // namespace nrff
