#include <array>

#include "pipeline/commands.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/manifest.h"
#include "pipeline/stage.h"

int main(int argc, char** argv) {
  CLI::App app("Photos to view-synthesis models, scored on photos held out.", "nrff");
  constexpr int kNamesColumns = 28;
  app.get_formatter()->column_width(kNamesColumns);
  app.set_version_flag("--version", nrff::Version());
  app.require_subcommand(0, 1);
  app.footer("Example: nrff run photos/\nHelp on one: nrff run --help");
  const std::array commands = {nrff::AddRunCommand(app),      nrff::AddPlanCommand(app), nrff::AddStatusCommand(app),
                               nrff::AddRenderCommand(app),   nrff::AddEvalCommand(app), nrff::AddReportCommand(app),
                               nrff::AddBenchmarkCommand(app)};
  app.allow_extras();  // not inherited by the commands; told of below
  return nrff::StageMain(app, argc, argv, [&] {
    for (const nrff::Command& command : commands) {
      if (command.app->parsed()) return command.run();
    }
    throw nrff::UsageError(
        (argc > 1 ? "'" + nrff::EscapePath(argv[1]) + "' is no command; give " : "give a command: ") +
        std::string("run, plan, status, render, eval, report or benchmark (see nrff --help)"));
  });
}
