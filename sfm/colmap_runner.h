// COLMAP as a child process: found, its version read, its commands run with a watchdog and a log.
//
// Options are named as in COLMAP 3.8. What a command of the installed version calls otherwise (3.13 renamed
// SiftExtraction.use_gpu to FeatureExtraction.use_gpu, …) is translated, and what it does not know at all is left out:
// each command's own --help is asked. Nothing needs a display (QT_QPA_PLATFORM=offscreen).
#pragma once

#include <filesystem>
#include <functional>
#include <map>
#include <string>
#include <string_view>
#include <vector>

#include "pipeline/process.h"

namespace nrff {

class Colmap {
 public:
  // The program: environment variable NRFF_COLMAP, else `colmap` in PATH. Throws ExternalToolError when it cannot be
  // started (saying how to install it) or does not introduce itself as COLMAP.
  Colmap(std::filesystem::path log, double stall_limit_seconds);

  const std::string& version() const { return version_; }  // "3.8"

  using Options = std::vector<std::pair<std::string, std::string>>;  // name without dashes, value
  // Runs a command to its end, whatever that is.
  ProcessResult Run(const std::string& command, const Options& options, double limit_seconds,
                    const std::function<void(std::string_view line)>& on_line = {});
  // As Run; throws ExternalToolError with the last lines and the log's name unless it succeeds.
  void RunOrThrow(const std::string& command, const Options& options, double limit_seconds,
                  const std::function<void(std::string_view line)>& on_line = {});
  [[noreturn]] void Fail(const std::string& command, const ProcessResult& result) const;

 private:
  const std::string& Help(const std::string& command);

  std::string program_;
  std::filesystem::path log_;
  double stall_limit_seconds_;
  std::string version_;
  std::map<std::string, std::string> help_;
};

}  // namespace nrff
