// nrff benchmark: every scene of a data set, and one table beside what was published.
#include <iostream>

#include "pipeline/benchmark.h"
#include "pipeline/commands.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/plan.h"
#include "pipeline/run.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

struct Options {
  std::string dir;
  BranchOptions branch;
  OutputOptions output;
  bool dry_run = false;
};

void Benchmark(const DataSet& data_set, Options options) {
  BranchOptions& branch = options.branch;
  for (const fs::path& scene : FindScenes(data_set, options.dir)) branch.targets.push_back(scene);
  const std::vector<BranchRequest> requests = MakeBranches(branch);
  if (options.dry_run) return PlanAndPrint(requests, options.output.json);

  const std::vector<BranchResult> results = RunRequests(requests, options.output.verbosity());
  std::vector<fs::path> roots;
  for (const BranchRequest& request : requests) roots.push_back(request.workspace.root());
  const fs::path folder = branch.workspace.empty() ? branch.folder : branch.workspace;
  const Json table = BenchmarkTable(data_set, folder, roots, requests.front().options);
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

}  // namespace

Command AddBenchmarkCommand(CLI::App& app) {
  CLI::App* command = app.add_subcommand("benchmark", "All scenes of a data set, beside published figures");
  command->require_subcommand(1);
  command->footer("Example: nrff benchmark tanks-and-temples TanksAndTemple/ --budget 20m");
  std::vector<Command> kinds;
  for (const DataSet& data_set : DataSets()) {
    auto options = std::make_shared<Options>();
    options->branch.in_folder = true;
    options->branch.folder = "work/" + data_set.name;
    // The size of the published figures; and no figure loses by rounding.
    options->branch.defaults = {{"max-image-size", std::to_string(std::max(data_set.width, data_set.height))},
                                {"bit-depth", "16"}};
    CLI::App* kind = command->add_subcommand(data_set.name, data_set.title);
    kind->add_option("DIR", options->dir, "Holds a folder per scene")->required()->type_name("");
    AddBranchOptions(*kind, options->branch);
    kind->add_flag("--dry-run", options->dry_run, "Say what would run, as `nrff plan`");
    AddVerbosityOptions(*kind, options->output);
    AddJsonOption(*kind, options->output);
    kind->footer("A scene's folder holds " + data_set.layout +
                 ".\nScenes that are not there are left out, and the table says so. The same command\n"
                 "goes on from what is there.\nExample: nrff benchmark " +
                 data_set.name + " DIR --budget 20m");
    kinds.push_back({kind, [&data_set, options] { Benchmark(data_set, *options); }});
  }
  return {command, [kinds] {
            for (const Command& kind : kinds) {
              if (kind.app->parsed()) kind.run();
            }
          }};
}

}  // namespace nrff
