#include "pipeline/run.h"

#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <iostream>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/local_executor.h"
#include "pipeline/log.h"
#include "pipeline/progress.h"
#include "pipeline/report.h"

namespace nrff {
namespace {

const char* StateText(Outcome::State state) {
  switch (state) {
    case Outcome::kReused:
      return "reused";
    case Outcome::kRan:
      return "ran";
    case Outcome::kFailed:
      return "failed";
    case Outcome::kNotRun:
      return "not run";
  }
  return "";
}

// A fact of a stage that was made; null when there is none.
Json Fact(const BranchResult& result, const std::string& stage, const char* key) {
  const BranchResult::Stage* found = result.Find(stage);
  return found != nullptr && found->manifest ? found->manifest->facts.value(key, Json()) : Json();
}

bool HasCompleteReport(const Workspace& workspace) {
  RealDisk disk;
  const ArtifactState report = disk.ReadArtifact(workspace.Artifact("report"));
  return report.manifest && report.manifest->facts.value("status", "") == "complete";
}

// A capture that failed gets a report with the diagnosis, unless a complete one would be lost.
void ReportFailures(const std::vector<BranchResult>& results) {
  for (const BranchResult& result : results) {
    const Workspace& workspace = result.request.workspace;
    if (result.FirstFailed() != nullptr && !HasCompleteReport(workspace)) WriteReport(workspace.root());
  }
}

// Photos were added: what there is of the earlier ones is kept for the stages to take over. Everything anew: they take
// over nothing.
void KeepOrForgetBase(const BranchRequest& request, const Json& extension, bool quiet) {
  const Workspace& workspace = request.workspace;
  if (request.from == StageNames().front()) return workspace.ForgetBase();
  if (extension.at("extension").is_object()) {
    // A model that is still in the making is not worth one that is done of fewer photos yet.
    const KeptFiles kept = ExtendableStages(workspace);
    if (kept.size() < kMostExtendable && workspace.HasBase("ingest")) return;
    workspace.KeepBase(kept);
    if (!quiet) LogInfo(fmt::format("{}: {}", request.name, ExtensionText(extension)));
  } else if (extension.at("why_anew").is_string() && !workspace.HasBase("ingest") && !quiet) {
    LogWarning(fmt::format("{}: {}", request.name, ExtensionText(extension)));
  }
}

}  // namespace

const BranchResult::Stage* BranchResult::Find(const std::string& stage) const {
  const auto found =
      std::find_if(stages.begin(), stages.end(), [&](const Stage& other) { return other.node.stage == stage; });
  return found == stages.end() ? nullptr : &*found;
}

const BranchResult::Stage* BranchResult::FirstFailed() const {
  const auto found = std::find_if(stages.begin(), stages.end(),
                                  [](const Stage& stage) { return stage.outcome.state == Outcome::kFailed; });
  return found == stages.end() ? nullptr : &*found;
}

std::vector<BranchResult> RunBranches(const std::vector<BranchRequest>& requests, std::vector<Node> nodes,
                                      const Machine& machine, Verbosity verbosity) {
  std::map<std::string, Workspace> workspaces;
  std::vector<BranchResult> results;
  for (const BranchRequest& request : requests) {
    workspaces.emplace(request.name, request.workspace);
    results.push_back({request, {}});
  }
  RealDisk disk;
  Graph graph(disk, Version());
  for (Node& node : nodes) graph.Add(std::move(node));
  std::vector<Outcome> outcomes;
  {
    Console console(
        std::cerr, [] { return TerminalColumns(STDERR_FILENO); }, verbosity, workspaces);
    LocalExecutor executor([&console] { console.Tick(); });
    outcomes = RunGraph(graph, executor, machine, console);
    if (const int signal = executor.StopSignal(); signal != 0) {
      throw Error(static_cast<ExitCode>(128 + signal),
                  fmt::format("stopped by signal {}: run the same command to go on from here", signal));
    }
  }
  for (size_t i = 0; i < graph.nodes().size(); ++i) {
    const Node& node = graph.nodes()[i];
    const auto result = std::find_if(results.begin(), results.end(),
                                     [&](const BranchResult& other) { return other.request.name == node.branch; });
    const bool usable = outcomes[i].state == Outcome::kReused || outcomes[i].state == Outcome::kRan;
    result->stages.push_back({node, outcomes[i], usable ? graph.Artifact(node).manifest : std::nullopt});
  }
  return results;
}

std::string ExtensionText(const Json& extension) {
  if (extension.at("why_anew").is_string()) {
    return "not only were photos added: nothing of the last run is taken over, since " +
           extension.at("why_anew").get<std::string>();
  }
  if (!extension.at("extension").is_object()) return {};
  return fmt::format(
      "{} photos were added to {}: their hold-out, features, matches, poses, frame and model are taken over "
      "(--force: everything anew)",
      extension.at("extension").value("n_added", 0), extension.at("extension").value("n_earlier", 0));
}

std::vector<BranchResult> RunRequests(const std::vector<BranchRequest>& requests, Verbosity verbosity) {
  std::vector<Json> extensions;
  {
    LocalExecutor executor;  // what only training would refuse is refused before an hour of other stages
    for (const BranchRequest& request : requests) {
      try {
        ProbeTraining(executor, request);
        extensions.push_back(ProbeExtension(executor, request));
      } catch (const Error& error) {
        if (requests.size() == 1) throw;
        throw Error(error.code(), request.name + ": " + error.what());
      }
    }
  }
  const Machine machine = ThisMachine();
  std::vector<WorkspaceLock> locks;
  std::vector<Node> nodes;
  for (size_t i = 0; i < requests.size(); ++i) {
    const BranchRequest& request = requests[i];
    request.workspace.Claim(request.capture);
    locks.emplace_back(request.workspace);
    KeepOrForgetBase(request, extensions[i], verbosity == Verbosity::kQuiet);
    request.workspace.WriteMarker({request.capture, request.options});
    nodes.push_back(FirstNode(request, machine));
  }
  std::vector<BranchResult> results = RunBranches(requests, std::move(nodes), machine, verbosity);
  ReportFailures(results);
  return results;
}

void ThrowIfFailed(const std::vector<BranchResult>& results) {
  for (const BranchResult& result : results) {
    const BranchResult::Stage* failed = result.FirstFailed();
    if (failed == nullptr) continue;
    throw Error(static_cast<ExitCode>(failed->outcome.job.exit_code),
                fmt::format("{}: {}: {} (log: {})", result.request.name, failed->node.stage, failed->outcome.job.error,
                            EscapePath(failed->node.log)));
  }
}

void PrintResult(const BranchResult& result, std::ostream& out) {
  out << result.request.name << '\n';
  const Json registered = Fact(result, "sfm", "n_registered"), n_images = Fact(result, "sfm", "n_images");
  if (registered.is_number() && n_images.is_number()) {
    out << fmt::format("  registered  {} of {} images\n", registered.get<int>(), n_images.get<int>());
  } else if (Fact(result, "ingest", "posed") == true) {
    out << "  registered  poses given with the capture\n";
  }
  const Json psnr = Fact(result, "eval", "psnr"), ssim = Fact(result, "eval", "ssim");
  if (psnr.is_number() && ssim.is_number()) {
    out << fmt::format("  held out    PSNR {:.2f} dB, SSIM {:.4f}", psnr.get<double>(), ssim.get<double>());
    const Json lpips = Fact(result, "eval", "lpips");
    out << (lpips.is_number() ? fmt::format(", LPIPS {:.4f}\n", lpips.get<double>()) : "\n");
  }
  std::string seconds;
  for (const BranchResult::Stage& stage : result.stages) {
    if (stage.manifest) {
      seconds += fmt::format("{}{} {:.1f}", seconds.empty() ? "" : ", ", stage.node.stage, stage.manifest->seconds);
    }
  }
  if (!seconds.empty()) out << "  seconds     " << seconds << '\n';
  if (const BranchResult::Stage* failed = result.FirstFailed(); failed != nullptr) {
    out << fmt::format("  failed      {}: {}\n", failed->node.stage, failed->outcome.job.error);
  }
  const BranchResult::Stage* report = result.Find("report");
  if (report != nullptr && report->manifest)
    out << "  report      " << EscapePath(result.request.workspace.Report()) << '\n';
}

Json ResultToJson(const BranchResult& result) {
  Json stages = Json::array();
  for (const BranchResult::Stage& stage : result.stages) {
    Json json = {{"stage", stage.node.stage}, {"state", StateText(stage.outcome.state)}};
    if (!stage.outcome.reason.empty()) json["reason"] = stage.outcome.reason;
    if (stage.manifest) {
      json["seconds"] = stage.manifest->seconds;
      json["peak_memory_bytes"] = stage.manifest->peak_memory_bytes;
    }
    if (stage.outcome.state == Outcome::kFailed) {
      json["exit_code"] = stage.outcome.job.exit_code;
      json["error"] = stage.outcome.job.error;
      json["log"] = EscapePath(stage.node.log);
    }
    stages.push_back(std::move(json));
  }
  const BranchResult::Stage* report = result.Find("report");
  const bool reported = report != nullptr && report->manifest;
  const BranchResult::Stage* failed = result.FirstFailed();
  return {{"name", result.request.name},
          {"capture", EscapePath(result.request.capture)},
          {"workspace", EscapePath(result.request.workspace.root())},
          {"exit_code", failed == nullptr ? 0 : failed->outcome.job.exit_code},
          {"registered", Fact(result, "sfm", "n_registered")},
          {"metrics",
           {{"psnr", Fact(result, "eval", "psnr")},
            {"ssim", Fact(result, "eval", "ssim")},
            {"lpips", Fact(result, "eval", "lpips")}}},
          {"stages", stages},
          {"report", reported ? Json(EscapePath(result.request.workspace.Report())) : Json()}};
}

}  // namespace nrff
