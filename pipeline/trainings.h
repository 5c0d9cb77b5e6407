// More trainings of a scene that has its poses: each in a workspace of its own whose ingest, sfm and pose are links to
// the scene's, so that they differ in nothing but training.
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "pipeline/json.h"
#include "pipeline/log.h"
#include "pipeline/stages.h"

namespace nrff {

// The scene's options but for what decides how long training takes, and renders of 16 bits; in the workspace `folder`,
// which lies two levels below the scene's and is claimed. Throws as Workspace::Claim.
BranchRequest TrainingBeside(const BranchRequest& scene, const std::filesystem::path& folder);

// Runs what of them is not fresh, from training to the scores of the held-out views, under the workspaces' locks.
// Throws what a stage failed with.
void RunTrainings(const BranchRequest& scene, const std::vector<BranchRequest>& trainings, Verbosity verbosity);

// {workspace: relative to `folder`, seed, seconds, seconds_evaluating, steps, samples, preset, threads, n_parameters,
// seconds_per_view, psnr, ssim, lpips}; null: not known. Seconds are of training alone.
Json TrainingRow(const std::filesystem::path& folder, const BranchRequest& training);

// {mean, least, most} of a figure of the rows; null where some row has none.
Json Band(const std::vector<Json>& rows, const char* key);

}  // namespace nrff
