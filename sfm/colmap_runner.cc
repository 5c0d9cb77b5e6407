#include "sfm/colmap_runner.h"

#include <cstdlib>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/log.h"

namespace nrff {
namespace {

constexpr double kHelpLimit_seconds = 60;

std::string Program() {
  const char* given = std::getenv("NRFF_COLMAP");
  return given && *given ? given : "colmap";
}

// The names an option has had, 3.8's first.
std::vector<std::string> Names(const std::string& option) {
  std::vector<std::string> names = {option};
  for (const auto& [before, after] : {std::pair<std::string, std::string>{"SiftExtraction.", "FeatureExtraction."},
                                      {"SiftMatching.", "FeatureMatching."},
                                      {"SiftMatching.", "TwoViewGeometry."}}) {
    if (option.starts_with(before)) names.push_back(after + option.substr(before.size()));
  }
  if (option == "random_seed") names.emplace_back("default_random_seed");
  return names;
}

}  // namespace

Colmap::Colmap(std::filesystem::path log, double stall_limit_seconds)
    : program_(Program()), log_(std::move(log)), stall_limit_seconds_(stall_limit_seconds) {
  const std::string install =
      "; install COLMAP (apt-get install colmap) or name it in the environment variable NRFF_COLMAP";
  try {
    const std::string& help = Help("help");
    const size_t name = help.find("COLMAP ");
    if (name == std::string::npos)
      throw ExternalToolError(EscapePath(program_) + " does not say that it is COLMAP" + install);
    const size_t begin = name + 7, end = help.find_first_of(" \n-(", begin);
    version_ = help.substr(begin, end - begin);
  } catch (const Error& error) {
    if (error.code() == ExitCode::kExternalTool && std::string(error.what()).find(install) == std::string::npos) {
      throw ExternalToolError(error.what() + install);
    }
    throw;
  }
}

const std::string& Colmap::Help(const std::string& command) {
  const auto [entry, is_new] = help_.try_emplace(command);
  if (!is_new) return entry->second;
  ProcessOptions process;
  process.command = command == "help" ? std::vector<std::string>{program_, command}
                                      : std::vector<std::string>{program_, command, "--help"};
  process.environment["QT_QPA_PLATFORM"] = "offscreen";
  process.limit_seconds = kHelpLimit_seconds;
  process.on_line = [&help = entry->second](std::string_view line) { help.append(line).append("\n"); };
  const ProcessResult result = RunProcess(process);
  if (result.end != ProcessResult::End::kExited) {
    throw ExternalToolError(EscapePath(program_) + " " + command + " " + DescribeEnd(result) + " when asked for help");
  }
  return entry->second;
}

ProcessResult Colmap::Run(const std::string& command, const Options& options, double limit_seconds,
                          const std::function<void(std::string_view line)>& on_line) {
  const std::string& help = Help(command);
  ProcessOptions process;
  process.command = {program_, command};
  std::string unknown;
  for (const auto& [option, value] : options) {
    bool known = false;
    for (const std::string& name : Names(option)) {
      if (help.find("--" + name + " ") == std::string::npos) continue;
      process.command.insert(process.command.end(), {"--" + name, value});
      known = true;
      break;
    }
    if (!known) unknown.append(" ").append(option);
  }
  if (!unknown.empty()) LogDetail("left out, since this COLMAP's " + command + " does not know them:" + unknown);
  process.environment["QT_QPA_PLATFORM"] = "offscreen";
  process.log = log_;
  process.on_line = on_line;
  process.limit_seconds = limit_seconds;
  process.stall_limit_seconds = stall_limit_seconds_;
  return RunProcess(process);
}

void Colmap::RunOrThrow(const std::string& command, const Options& options, double limit_seconds,
                        const std::function<void(std::string_view line)>& on_line) {
  const ProcessResult result = Run(command, options, limit_seconds, on_line);
  if (!result.Succeeded()) Fail(command, result);
}

void Colmap::Fail(const std::string& command, const ProcessResult& result) const {
  constexpr size_t kShown = 3;
  std::string last;
  for (size_t i = result.last_lines.size() > kShown ? result.last_lines.size() - kShown : 0;
       i < result.last_lines.size(); ++i) {
    last += (last.empty() ? "" : " | ") + result.last_lines[i];
  }
  throw ExternalToolError("colmap " + command + " " + DescribeEnd(result) +
                          (last.empty() ? "; it printed nothing" : "; its last lines: " + last) + "; its log is " +
                          EscapePath(log_));
}

}  // namespace nrff
