// What each part of NRFF is worth on one scene: the settings of the one model that the paper compares ([Han23] Table 2
// and its ablation of the levels), each trained for equal steps on the scene's own poses.
//
//   ablation.json  (schema 1)
//     name, steps, seeds, preset, width, height (px, of the largest view)
//     groups  [{name, title, note, published: what the published figures are of,
//               rows [{name, label, settings: changes of the preset, as --set takes them, published: dB or null,
//                      own: whether it is the model as it is, runs [TrainingRow],
//                      psnr, ssim, lpips, seconds, seconds_per_view, n_parameters: {mean, least, most} or null}]}]
//     host: where this was written; version, date (UTC) of writing
//   ablation.md, ablation.html  the same for people
#pragma once

#include <cstdint>
#include <string>

#include "pipeline/json.h"
#include "pipeline/log.h"
#include "pipeline/workspace.h"

namespace nrff {

struct AblationOptions {
  int64_t steps = 0;  // 0: as many as the scene's model was trained
  int n_seeds = 1;
};

// Sizes are those of the workspace's trained model. Trains in workspaces of their own in `workspace`/ablation; what is
// there and not stale is kept. Writes the three files there. Throws what a stage failed with, InputError where the
// workspace has no trained model.
Json MeasureAblation(const Workspace& workspace, const AblationOptions& options, Verbosity verbosity);

std::string AblationMarkdown(const Json& result);

}  // namespace nrff
