// One table of a data set: what came out of each of its scenes, the means, the published figures, and how the protocol
// of ours differs from theirs.
//
//   benchmark.json  (schema 1)
//     data_set      {name, title, scenes, width, height, split, background}
//     scenes        [{name, published: whether the published means are over it, too, workspace, report, status,
//     failure,
//                     psnr, ssim, lpips, variants, n_images, width, height, training_seconds, steps, preset, device,
//                     seconds_per_view, samples_per_ray, model_bytes, peak_memory_bytes}]; null: not known
//     missing       published scenes that are not there
//     mean          {psnr, ssim, lpips, variants, training_seconds, n_scenes}: over the scenes that have the figure
//     published     [{method, psnr, ssim, lpips, training, source}]: means over all published scenes
//     differences   [what has to be kept in mind when the figures are compared]
//     command: as given, without places on this machine; host: of the first scene; version, date (UTC) of writing
//   benchmark.md, benchmark.html  the same for people
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "pipeline/data_sets.h"
#include "pipeline/json.h"

namespace nrff {

// From what lies in the workspaces, whatever of it is there. Paths are relative to `folder`.
Json BenchmarkTable(const DataSet& data_set, const std::filesystem::path& folder,
                    const std::vector<std::filesystem::path>& workspaces, const std::string& command);

std::string BenchmarkMarkdown(const Json& table);

// Writes the three files into `folder`. Throws ResourceError.
void WriteBenchmark(const std::filesystem::path& folder, const Json& table);

}  // namespace nrff
