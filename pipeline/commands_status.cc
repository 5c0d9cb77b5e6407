// nrff status: what is done, missing, stale and why, failed.
#include <fmt/format.h>

#include <iostream>

#include "pipeline/branches.h"
#include "pipeline/commands.h"
#include "pipeline/files.h"
#include "pipeline/progress.h"

namespace nrff {
namespace {

struct StageStatus {
  std::string stage;
  std::string state;   // "done", "missing", "stale", "undecided", "failed"
  std::string reason;  // why it is not done
  int exit_code = 0;   // failed
  double seconds = 0;  // done
  uint64_t peak_memory_bytes = 0;
};

std::vector<StageStatus> StatusOf(const BranchRequest& request) {
  RealDisk disk;
  Graph graph(disk, Version());
  graph.Add(FirstNode(request, ThisMachine()));
  // What ingest found before stands in for what it will find: status starts nothing.
  const std::vector<Verdict> verdicts = graph.Plan([&](const Node& ingest) {
    const ArtifactState& before = graph.Artifact(ingest);
    return before.manifest ? before.manifest->facts : Json{{"posed", false}};
  });
  std::vector<StageStatus> stages;
  for (size_t i = 0; i < verdicts.size(); ++i) {
    const Node& node = graph.nodes()[i];
    StageStatus status{node.stage, "done", verdicts[i].reason};
    if (const auto& manifest = graph.Artifact(node).manifest; manifest) {
      status.seconds = manifest->seconds;
      status.peak_memory_bytes = manifest->peak_memory_bytes;
    }
    std::error_code absent;
    const bool made = std::filesystem::exists(request.workspace.Artifact(node.stage), absent);
    if (verdicts[i].state == Verdict::kStale) status.state = made ? "stale" : "missing";
    if (verdicts[i].state == Verdict::kUndecided) status.state = "undecided";
    const std::optional<StageRecord> record = request.workspace.LastRecord(node.stage);
    if (verdicts[i].state != Verdict::kFresh && record && record->exit_code != 0) {
      status.state = "failed";
      status.reason = fmt::format("exit code {}: {}", record->exit_code, record->error);
      status.exit_code = record->exit_code;
    }
    stages.push_back(status);
  }
  return stages;
}

// What the last eval found, whether it still stands or not; null where there is none.
Json Metrics(const BranchRequest& request) {
  RealDisk disk;
  const std::optional<Manifest> eval = disk.ReadArtifact(request.workspace.Artifact("eval")).manifest;
  Json metrics = Json::object();
  for (const char* name : {"psnr", "ssim", "lpips"}) metrics[name] = eval ? eval->facts.value(name, Json()) : Json();
  return metrics;
}

std::optional<std::string> Report(const BranchRequest& request) {
  std::error_code absent;
  const std::filesystem::path report = request.workspace.Report();
  return std::filesystem::exists(report, absent) ? std::optional(EscapePath(report)) : std::nullopt;
}

void PrintStatus(const BranchRequest& request, const std::vector<StageStatus>& stages) {
  std::cout << EscapePath(request.workspace.root()) << " (" << EscapePath(request.capture) << ")\n";
  if (const auto holder = WorkspaceLock::Holder(request.workspace); holder) {
    std::cout << "  in use by process " << *holder << '\n';
  }
  for (const StageStatus& status : stages) {
    const std::string text = status.state != "done" ? status.reason
                                                    : FormatSeconds(status.seconds) + ", peak memory " +
                                                          FormatBytes(static_cast<double>(status.peak_memory_bytes));
    std::cout << fmt::format("  {:<8}{:<11}{}\n", status.stage, status.state, text);
  }
  const Json metrics = Metrics(request);
  if (metrics.at("psnr").is_number() && metrics.at("ssim").is_number()) {
    std::cout << fmt::format("  held out PSNR {:.2f} dB, SSIM {:.4f}\n", metrics.at("psnr").get<double>(),
                             metrics.at("ssim").get<double>());
  }
  if (const auto report = Report(request); report) std::cout << "  report   " << *report << '\n';
}

Json StatusToJson(const BranchRequest& request, const std::vector<StageStatus>& stages) {
  Json list = Json::array();
  for (const StageStatus& status : stages) {
    Json json = {{"stage", status.stage}, {"state", status.state}};
    if (status.state == "done") {
      json["seconds"] = status.seconds;
      json["peak_memory_bytes"] = status.peak_memory_bytes;
    } else {
      json["reason"] = status.reason;
    }
    if (status.state == "failed") {
      json["exit_code"] = status.exit_code;
      json["log"] = EscapePath(request.workspace.Log(status.stage));
    }
    list.push_back(std::move(json));
  }
  const auto holder = WorkspaceLock::Holder(request.workspace);
  const auto report = Report(request);
  return {{"name", request.name},
          {"workspace", EscapePath(request.workspace.root())},
          {"capture", EscapePath(request.capture)},
          {"in_use_by_process", holder ? Json(*holder) : Json()},
          {"stages", list},
          {"metrics", Metrics(request)},
          {"report", report ? Json(*report) : Json()}};
}

void Status(const std::vector<std::string>& paths, bool as_json) {
  Json all = Json::array();
  for (const std::string& path : paths) {
    for (const Workspace& workspace : FindWorkspaces(path)) {
      const BranchRequest request = BranchOf(workspace);
      const std::vector<StageStatus> stages = StatusOf(request);
      if (as_json) {
        all.push_back(StatusToJson(request, stages));
      } else {
        PrintStatus(request, stages);
      }
    }
  }
  if (as_json) PrintJson({{"workspaces", all}});
}

}  // namespace

Command AddStatusCommand(CLI::App& app) {
  struct Options {
    std::vector<std::string> workspaces;
    OutputOptions output;
  };
  auto options = std::make_shared<Options>();
  CLI::App* command = app.add_subcommand("status", "What is done, missing, stale (and why), failed");
  command->add_option("WORKSPACE", options->workspaces, "Made by `nrff run`, or a folder of such")
      ->required()
      ->type_name("");
  AddJsonOption(*command, options->output);
  command->footer("Example: nrff status work/castle");
  return {command, [options] { Status(options->workspaces, options->output.json); }};
}

}  // namespace nrff
