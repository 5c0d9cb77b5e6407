// nrff run, nrff eval, nrff report: what makes artifacts.
#include <fmt/format.h>

#include <algorithm>
#include <iostream>

#include "pipeline/commands.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/local_executor.h"
#include "pipeline/plan.h"
#include "pipeline/report.h"
#include "pipeline/run.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr char kJointReport[] = "report/report.html";

void Run(const BranchOptions& branch, bool dry_run, const OutputOptions& output) {
  const std::vector<BranchRequest> requests = MakeBranches(branch);
  if (dry_run) return PlanAndPrint(requests, output.json);
  std::vector<Workspace> workspaces;
  std::vector<fs::path> roots;
  for (const BranchRequest& request : requests) {
    workspaces.push_back(request.workspace);
    roots.push_back(request.workspace.root());
  }
  const fs::path folder = CommonFolder(workspaces);
  const std::vector<BranchResult> results = RunRequests(requests, output.verbosity());
  const bool joint = results.size() > 1 && branch.until.empty();
  const fs::path joint_report = folder / kJointReport;
  if (joint) WriteJointReport(folder, roots);
  if (output.json) {
    Json captures = Json::array();
    for (const BranchResult& result : results) captures.push_back(ResultToJson(result));
    PrintJson({{"captures", captures}, {"joint_report", joint ? Json(EscapePath(joint_report)) : Json()}});
  } else if (!output.quiet) {
    for (const BranchResult& result : results) PrintResult(result, std::cout);
    if (joint) std::cout << "all together: " << EscapePath(joint_report) << '\n';
  }
  ThrowIfFailed(results);
}

void PrintScores(const Json& metrics) {
  size_t width = 4;
  for (const Json& image : metrics.at("images")) width = std::max(width, image.at("name").get<std::string>().size());
  const auto row = [&](const std::string& name, const Json& scores) {
    // A score can be null: identical images, images smaller than the SSIM window, no held-out view.
    const auto figure = [&](const char* metric, const char* format) {
      const Json& score = scores.at(metric);
      return score.is_null() ? std::string("—") : fmt::format(fmt::runtime(format), score.get<double>());
    };
    std::cout << fmt::format("{:<{}}  {:>6}  {:>6}  {:>6}\n", name, width, figure("psnr", "{:.2f}"),
                             figure("ssim", "{:.4f}"), figure("lpips", "{:.4f}"));
  };
  std::cout << fmt::format("{:<{}}  {:>6}  {:>6}  {:>6}\n", "view", width, "PSNR", "SSIM", "LPIPS");
  for (const Json& image : metrics.at("images")) row(image.at("name").get<std::string>(), image);
  row("mean", metrics.at("metrics"));
}

void Eval(const std::string& path, const OutputOptions& output) {
  const BranchRequest request = BranchOf(Workspace(path));
  const WorkspaceLock lock(request.workspace);
  const Manifest ingest = request.workspace.Require("ingest");
  const bool posed = Get<bool>(ingest.facts, "posed", "ingest's manifest");
  for (const char* stage : {"pose", "render"}) request.workspace.Require(stage);
  const Machine machine = ThisMachine();
  ThrowIfFailed(RunBranches({request}, BranchToRunAgain(request, machine, posed, {"eval", "report"}), machine,
                            output.verbosity()));
  const fs::path metrics_path = request.workspace.Artifact("eval") / "metrics.json";
  const Json metrics = ReadJson(metrics_path);
  try {
    if (output.json) {
      PrintJson(metrics);
    } else {
      PrintScores(metrics);
    }
  } catch (const Json::exception& error) {
    throw CorruptError(EscapePath(metrics_path) + " is not as eval writes it: " + error.what());
  }
}

void Report(const std::vector<std::string>& paths) {
  std::vector<Workspace> workspaces;
  for (const std::string& path : paths) {
    for (Workspace& workspace : FindWorkspaces(path)) workspaces.push_back(std::move(workspace));
  }
  const fs::path folder = CommonFolder(workspaces);
  std::vector<fs::path> roots;
  for (const Workspace& workspace : workspaces) {
    const WorkspaceLock lock(workspace);
    WriteReport(workspace.root());
    roots.push_back(workspace.root());
    std::cout << EscapePath(workspace.Report()) << '\n';
  }
  if (roots.size() == 1) return;
  WriteJointReport(folder, roots);
  std::cout << EscapePath(folder / kJointReport) << '\n';
}

}  // namespace

Command AddRunCommand(CLI::App& app) {
  struct Options {
    BranchOptions branch;
    OutputOptions output;
    bool dry_run = false;
  };
  auto options = std::make_shared<Options>();
  CLI::App* command = app.add_subcommand("run", "Photos to a model and a scored report");
  AddTargetOption(*command, options->branch);
  AddBranchOptions(*command, options->branch);
  command->add_flag("--dry-run", options->dry_run, "Say what would run, as `nrff plan`");
  AddVerbosityOptions(*command, options->output);
  AddJsonOption(*command, options->output);
  command->footer("Killed at any moment, the same command goes on. Several share a joint report.\n" +
                  std::string(kFeaturesHelp) + "Example: nrff run castle/ --budget 10m");
  return {command, [options] { Run(options->branch, options->dry_run, options->output); }};
}

Command AddEvalCommand(CLI::App& app) {
  struct Options {
    std::string workspace;
    OutputOptions output;
  };
  auto options = std::make_shared<Options>();
  CLI::App* command = app.add_subcommand("eval", "The scores again, from the files");
  command->add_option("WORKSPACE", options->workspace, "Made by `nrff run`")->required()->type_name("");
  AddVerbosityOptions(*command, options->output);
  AddJsonOption(*command, options->output);
  command->footer("Example: nrff eval work/castle");
  return {command, [options] { Eval(options->workspace, options->output); }};
}

Command AddReportCommand(CLI::App& app) {
  struct Options {
    std::vector<std::string> workspaces;
    OutputOptions output;
  };
  auto options = std::make_shared<Options>();
  CLI::App* command = app.add_subcommand("report", "The report again; a joint one for several workspaces");
  command->add_option("WORKSPACE", options->workspaces, "Made by `nrff run`, or a folder of such")
      ->required()
      ->type_name("");
  AddVerbosityOptions(*command, options->output);
  command->footer(
      "A joint report goes to report/ in the folder that the workspaces lie in.\n"
      "Example: nrff report work/castle work/fox");
  return {command, [options] {
            SetVerbosity(options->output.verbosity());
            Report(options->workspaces);
          }};
}

}  // namespace nrff
