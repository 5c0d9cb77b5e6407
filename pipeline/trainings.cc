#include "pipeline/trainings.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/report_summary.h"
#include "pipeline/run.h"

namespace nrff {

namespace fs = std::filesystem;

BranchRequest TrainingBeside(const BranchRequest& scene, const fs::path& folder) {
  BranchRequest request = scene;
  request.name = folder.filename().string();
  request.workspace = Workspace(folder);
  for (const char* decides : {"steps", "budget"}) request.options.erase(decides);
  request.options["bit-depth"] = "16";
  request.workspace.Claim(request.capture);
  for (const char* shared : {"ingest", "sfm", "pose"}) {
    const fs::path link = request.workspace.Artifact(shared);
    std::error_code error;
    if (fs::exists(scene.workspace.Artifact(shared), error) && !fs::exists(fs::symlink_status(link, error))) {
      fs::create_symlink(fs::path("../..") / shared, link);
    }
  }
  return request;
}

void RunTrainings(const BranchRequest& scene, const std::vector<BranchRequest>& trainings, Verbosity verbosity) {
  const bool posed = Get<bool>(scene.workspace.Require("ingest").facts, "posed", "ingest's manifest");
  const Machine machine = ThisMachine();
  std::vector<WorkspaceLock> locks;
  std::vector<Node> nodes;
  for (const BranchRequest& training : trainings) {
    locks.emplace_back(training.workspace);
    training.workspace.WriteMarker({training.capture, training.options});
    for (Node& node : BranchOnPoses(training, machine, posed)) nodes.push_back(std::move(node));
  }
  ThrowIfFailed(RunBranches(trainings, std::move(nodes), machine, verbosity));
}

Json TrainingRow(const fs::path& folder, const BranchRequest& training) {
  const WorkspaceState state = ReadWorkspace(training.workspace.root());
  const Json &train = state.Facts("train"), &eval = state.Facts("eval");
  const auto seed = training.options.find("seed");
  return {{"workspace", EscapePath(fs::proximate(state.root, fs::absolute(folder)))},
          {"seed", seed == training.options.end() ? 0 : std::stoi(seed->second)},
          {"seconds", At(train, "seconds_training")},
          {"seconds_evaluating", At(train, "seconds_evaluating")},
          {"steps", At(train, "steps")},
          {"samples", At(train, "samples")},
          {"preset", At(train, "preset")},
          {"threads", At(train, "threads")},
          {"n_parameters", At(train, "n_parameters")},
          {"seconds_per_view", At(state.Facts("render"), "seconds_per_view")},
          {"psnr", At(eval, "psnr")},
          {"ssim", At(eval, "ssim")},
          {"lpips", At(eval, "lpips")}};
}

Json Band(const std::vector<Json>& rows, const char* key) {
  double sum = 0, least = HUGE_VAL, most = -HUGE_VAL;
  for (const Json& row : rows) {
    if (!row.at(key).is_number()) return nullptr;
    const double value = row.at(key).get<double>();
    sum += value;
    least = std::min(least, value);
    most = std::max(most, value);
  }
  return rows.empty() ? Json() : Json({{"mean", sum / double(rows.size())}, {"least", least}, {"most", most}});
}

}  // namespace nrff
