#include "pipeline/log.h"

#include <cstdio>

namespace nrff {
namespace {

Verbosity g_verbosity = Verbosity::kNormal;

void Write(const char* severity, const std::string& message) {
  // One write per line: lines of parallel threads don't interleave.
  const std::string line = std::string(severity) + ": " + message + "\n";
  std::fwrite(line.data(), 1, line.size(), stderr);
}

}  // namespace

void SetVerbosity(Verbosity verbosity) { g_verbosity = verbosity; }

Verbosity GetVerbosity() { return g_verbosity; }

void LogInfo(const std::string& message) {
  if (g_verbosity != Verbosity::kQuiet) Write("info", message);
}

void LogDetail(const std::string& message) {
  if (g_verbosity == Verbosity::kVerbose) Write("detail", message);
}

void LogWarning(const std::string& message) { Write("warning", message); }

}  // namespace nrff
