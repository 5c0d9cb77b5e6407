// nrff benchmark: every scene of a data set, and one table beside what was published; or one scene's error against
// run time; or what each part of the model is worth on it; or how accurate the software is on this machine.
#include <algorithm>
#include <iostream>
#include <sstream>

#include "pipeline/ablation.h"
#include "pipeline/benchmark.h"
#include "pipeline/commands.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/plan.h"
#include "pipeline/report.h"
#include "pipeline/run.h"
#include "pipeline/stability.h"
#include "pipeline/stage.h"
#include "pipeline/stages.h"
#include "pipeline/work_precision.h"
#include "pipeline/workspace.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

struct Options {
  std::string dir;
  BranchOptions branch;
  OutputOptions output;
  bool dry_run = false;
};

// The command line as it was given, without what is a place on this machine: DIR stands for the data set, files are
// named without their folders.
std::string CommandLine(const std::string& dir) {
  std::istringstream arguments(ReadFile("/proc/self/cmdline"));
  std::string text = "nrff", argument;
  std::getline(arguments, argument, '\0');
  while (std::getline(arguments, argument, '\0')) {
    if (argument == "-w" || argument == "--workspace") {
      std::getline(arguments, argument, '\0');
      continue;
    }
    if (argument.starts_with("--workspace=") || argument.starts_with("-w")) continue;
    const size_t value = argument.starts_with("--") ? argument.find('=') + 1 : 0;  // npos + 1 is 0
    const size_t slash = argument.rfind('/');
    if (argument == dir) {
      argument = "DIR";
    } else if (slash != std::string::npos) {
      argument.erase(value, slash + 1 - value);
    }
    const bool plain = argument.find_first_of(" '\"$`|*?\\") == std::string::npos;
    text += plain ? " " + EscapePath(argument) : " '" + EscapePath(argument) + "'";
  }
  return text;
}

void Benchmark(const DataSet& data_set, Options options) {
  BranchOptions& branch = options.branch;
  for (const fs::path& scene : FindScenes(data_set, options.dir)) branch.targets.push_back(scene);
  const std::vector<BranchRequest> requests = MakeBranches(branch);
  if (options.dry_run) return PlanAndPrint(requests, options.output.json);

  const std::vector<BranchResult> results = RunRequests(requests, options.output.verbosity());
  std::vector<fs::path> roots;
  roots.reserve(requests.size());
  for (const BranchRequest& request : requests) roots.push_back(request.workspace.root());
  const fs::path folder = branch.workspace.empty() ? branch.folder : branch.workspace;
  const Json table = BenchmarkTable(data_set, folder, roots, CommandLine(options.dir));
  WriteBenchmark(folder, table);
  if (options.output.json) {
    PrintJson(table);
  } else if (!options.output.quiet) {
    std::cout << BenchmarkMarkdown(table);
  }
  if (!options.output.quiet && !options.output.json) {
    std::cout << "\nthe table: " << EscapePath(folder / "benchmark.html") << ", .md, .json\n";
  }
  ThrowIfFailed(results);
}

struct PrecisionOptions {
  std::string workspace, budgets = "15s,30s,1m", seeds = "3";
  std::vector<std::string> parts = {"training", "rendering", "scoring", "poses"};
  OutputOptions output;
};

struct AblationCommandOptions {
  std::string workspace, steps = "0", seeds = "1";
  OutputOptions output;
};

std::string CheckSeeds(const std::string& text) { return CheckRange(text, 1, 100); }

std::vector<double> ParseBudgets(const std::string& text) {
  std::vector<double> budgets;
  std::istringstream parts(text);
  for (std::string part; std::getline(parts, part, ',');) budgets.push_back(ParseDuration(part, "--budgets"));
  std::sort(budgets.begin(), budgets.end());
  budgets.erase(std::unique(budgets.begin(), budgets.end()), budgets.end());
  if (budgets.empty()) throw UsageError("--budgets is empty; give times, as 15s,1m");
  return budgets;
}

void WorkPrecision(const PrecisionOptions& options) {
  const Workspace workspace(options.workspace);
  const Json result = MeasureWorkPrecision(
      workspace, {ParseBudgets(options.budgets), std::stoi(options.seeds), options.parts}, options.output.verbosity());
  if (options.output.json) {
    PrintJson(result);
  } else if (!options.output.quiet) {
    std::cout << WorkPrecisionMarkdown(result)
              << "\nthe curves: " << EscapePath(workspace.root() / "work-precision/work_precision.html")
              << ", .md, .json\n";
  }
}

Command AddWorkPrecision(CLI::App& command) {
  auto options = std::make_shared<PrecisionOptions>();
  CLI::App* kind = command.add_subcommand("work-precision", "One scene's error against run time");
  kind->add_option("WORKSPACE", options->workspace, "Made by `nrff run`")->required()->type_name("");
  kind->add_option("--budgets", options->budgets, "Training times (default: 15s,30s,1m)")->type_name("TIMES");
  kind->add_option("--seeds", options->seeds, "Trainings of each (default: 3)")->type_name("N")->check(CheckSeeds);
  kind->add_option("--parts", options->parts, "Of training,rendering,scoring,poses (default: all)")
      ->type_name("PARTS")
      ->delimiter(',')
      ->allow_extra_args(false)
      ->check([](const std::string& text) {
        const bool known = text == "training" || text == "rendering" || text == "scoring" || text == "poses";
        return known ? std::string() : "'" + text + "' is no part; there are training, rendering, scoring and poses";
      });
  AddVerbosityOptions(*kind, options->output);
  AddJsonOption(*kind, options->output);
  kind->footer(
      "Trains anew for every time and seed on the scene's poses, renders a few views at\n"
      "many settings and, where the capture brings poses, estimates them at several\n"
      "settings, too. The same command goes on from what is there.\n"
      "Example: nrff benchmark work-precision work/castle --budgets 30s,2m");
  return {kind, [options] { WorkPrecision(*options); }};
}

void Ablation(const AblationCommandOptions& options) {
  const Workspace workspace(options.workspace);
  const Json result =
      MeasureAblation(workspace, {std::stoll(options.steps), std::stoi(options.seeds)}, options.output.verbosity());
  if (options.output.json) {
    PrintJson(result);
  } else if (!options.output.quiet) {
    std::cout << AblationMarkdown(result) << "\nthe tables: " << EscapePath(workspace.root() / "ablation/ablation.html")
              << ", .md, .json\n";
  }
}

Command AddAblation(CLI::App& command) {
  auto options = std::make_shared<AblationCommandOptions>();
  CLI::App* kind = command.add_subcommand("ablation", "What each part of the model is worth");
  kind->add_option("WORKSPACE", options->workspace, "Made by `nrff run`")->required()->type_name("");
  kind->add_option("--steps", options->steps, "Of every training (default: as the scene's model)")
      ->type_name("N")
      ->check([](const std::string& text) { return CheckRange(text, 1, 100'000'000); });
  kind->add_option("--seeds", options->seeds, "Trainings of each (default: 1)")->type_name("N")->check(CheckSeeds);
  AddVerbosityOptions(*kind, options->output);
  AddJsonOption(*kind, options->output);
  kind->footer(
      "Trains the settings that the paper compares on the scene's poses, for equal steps:\n"
      "TensoRF's grids and the multiscale ones, four encodings of directions, 1 to 16\n"
      "levels. The same command goes on from what is there.\n"
      "Example: nrff benchmark ablation work/castle --steps 3000");
  return {kind, [options] { Ablation(*options); }};
}

struct StabilityOptions {
  std::string workspace, out = "work/stability";
  OutputOptions output;
};

void Stability(const StabilityOptions& options) {
  const bool of_workspace = !options.workspace.empty();
  if (of_workspace) Workspace(options.workspace).ReadMarker();
  const fs::path out = of_workspace ? fs::path(options.workspace) / kStabilityFolder : fs::path(options.out);
  const Json result = MeasureStability(ExecutableFolder().parent_path() / "tests", out);
  if (of_workspace) WriteReport(options.workspace);
  if (options.output.json) {
    PrintJson(result);
  } else if (!options.output.quiet) {
    std::cout << StabilityMarkdown(result) << "\nthe table: " << EscapePath(out / "stability.html") << ", .md, .json\n";
  }
  if (const int n = result.at("n_exceeded").get<int>(); n > 0) {
    throw ExternalToolError(std::to_string(n) + " stability cases are beyond their bounds on this machine; see " +
                            EscapePath(out / "stability.md"));
  }
}

Command AddStability(CLI::App& command) {
  auto options = std::make_shared<StabilityOptions>();
  CLI::App* kind = command.add_subcommand("stability", "Accuracy on stiff and extreme cases");
  CLI::Option* workspace = kind->add_option("WORKSPACE", options->workspace, "Its report shows the table");
  kind->add_option("--out", options->out, "Where the table goes (default: work/stability)")
      ->type_name("DIR")
      ->excludes(workspace);
  AddVerbosityOptions(*kind, options->output);
  AddJsonOption(*kind, options->output);
  kind->footer(
      "Runs the tests in tests/stability and shows every case's error beside the bound\n"
      "that follows from the number format.\n"
      "Example: nrff benchmark stability work/castle");
  return {kind, [options] { Stability(*options); }};
}

}  // namespace

Command AddBenchmarkCommand(CLI::App& app) {
  CLI::App* command = app.add_subcommand("benchmark", "Data sets; error against time; ablation; stability");
  command->require_subcommand(1);
  command->footer("Example: nrff benchmark tanks-and-temples TanksAndTemple/ --budget 20m");
  std::vector<Command> kinds;
  for (const DataSet& data_set : DataSets()) {
    auto options = std::make_shared<Options>();
    options->branch.in_folder = true;
    options->branch.folder = "work/" + data_set.name;
    // The size of the published figures; and no figure loses by rounding.
    options->branch.defaults = {{"bit-depth", "16"}};
    if (data_set.width > 0) {
      options->branch.defaults["max-image-size"] = std::to_string(std::max(data_set.width, data_set.height));
    }
    CLI::App* kind = command->add_subcommand(data_set.name, data_set.title);
    kind->add_option("DIR", options->dir, "Holds a folder per scene")->required()->type_name("");
    AddBranchOptions(*kind, options->branch);
    kind->add_flag("--dry-run", options->dry_run, "Say what would run, as `nrff plan`");
    AddVerbosityOptions(*kind, options->output);
    AddJsonOption(*kind, options->output);
    kind->footer("A scene's folder holds " + data_set.layout + ".\n" +
                 (data_set.scenes.empty() ? "" : "Scenes that are not there are left out, and the table says so.\n") +
                 "The same command goes on from what is there.\nExample: nrff benchmark " + data_set.name +
                 " DIR --budget 20m");
    kinds.push_back({kind, [&data_set, options] { Benchmark(data_set, *options); }});
  }
  kinds.push_back(AddWorkPrecision(*command));
  kinds.push_back(AddAblation(*command));
  kinds.push_back(AddStability(*command));
  return {command, [kinds] {
            for (const Command& kind : kinds) {
              if (kind.app->parsed()) kind.run();
            }
          }};
}

}  // namespace nrff
