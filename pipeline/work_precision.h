// Error against run time of one scene: what more training time buys, and what rendering loses by being fast.
//
//   work_precision.json  (schema 1)
//     name
//     parts      that were asked for; the others are null
//     training   {budgets: [s], seeds
//                 runs [{budget_seconds, and as TrainingRow says}]: figures of all held-out views
//                 bands [{budget_seconds, presets {NAME: runs}, seconds, steps, samples, psnr, ssim, lpips: {mean,
//                         least, most} or null}]
//                 time_to [{psnr, seconds: the shortest measured training whose mean reaches it, or null}]}
//     rendering, quadrature: as render/work_precision.h says
//     scoring    as eval/work_precision.h says
//     poses      where the capture brings poses: estimated without them, and compared with them (nrff-pose compare)
//                 {reason: why there is nothing, or null
//                  points [{image_size, features, matching, seconds: of COLMAP, n_registered, n_images, errors, error:
//                           how it failed, or null, chosen: what nrff run begins with for so many photos}]}
//     host: that the poses were made on; version, date (UTC) of writing
//   work_precision.md, work_precision.html  the same for people
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "pipeline/branches.h"
#include "pipeline/json.h"
#include "pipeline/log.h"

namespace nrff {

struct WorkPrecisionOptions {
  std::vector<double> budgets = {15, 30, 60};  // s
  int n_seeds = 3;
  std::vector<std::string> parts = {"training", "rendering", "scoring", "poses"};
};

// Trains the scene of the workspace once for every budget and seed, in workspaces of their own in
// `workspace`/work-precision that share its poses, measures rendering on its model and scoring on its renders, and
// estimates poses from its photos at several settings. What is there and not stale is kept, with the times that it took
// when it was made. Writes the three files there after every part. Throws what a stage failed with, InputError where
// what a part reads is not made.
Json MeasureWorkPrecision(const Workspace& workspace, const WorkPrecisionOptions& options, Verbosity verbosity);

std::string WorkPrecisionMarkdown(const Json& result);

}  // namespace nrff
