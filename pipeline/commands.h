// The sub-commands of `nrff`. Each Add… gives the app a sub-command and returns what that does once the command line
// is parsed; it throws Error to end with an exit code.
#pragma once

#include <CLI/CLI.hpp>
#include <functional>
#include <string>

#include "pipeline/json.h"
#include "pipeline/log.h"

namespace nrff {

struct Command {
  CLI::App* app = nullptr;
  std::function<void()> run;
};

Command AddRunCommand(CLI::App& app);
Command AddPlanCommand(CLI::App& app);
Command AddStatusCommand(CLI::App& app);
Command AddRenderCommand(CLI::App& app);
Command AddEvalCommand(CLI::App& app);
Command AddReportCommand(CLI::App& app);
Command AddBenchmarkCommand(CLI::App& app);

// What every sub-command shares.
struct OutputOptions {
  bool quiet = false, verbose = false, json = false;
  Verbosity verbosity() const { return quiet ? Verbosity::kQuiet : verbose ? Verbosity::kVerbose : Verbosity::kNormal; }
};
void AddVerbosityOptions(CLI::App& command, OutputOptions& output);
void AddJsonOption(CLI::App& command, OutputOptions& output);

// Validators with nothing to add to the help text.
std::string CheckPositive(const std::string& text);
std::string CheckWhole(const std::string& text);
std::string CheckRange(const std::string& text, int least, int most);
std::string CheckDevice(const std::string& text);

void PrintJson(const Json& json);  // to stdout

}  // namespace nrff
