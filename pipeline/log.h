// Log lines of the stages: to stderr, prefixed by severity; the driver keeps them per stage and shows what it was asked
// to.
#pragma once

#include <string>

namespace nrff {

enum class Verbosity { kQuiet, kNormal, kVerbose };
void SetVerbosity(Verbosity verbosity);
Verbosity GetVerbosity();

void LogInfo(const std::string& message);     // "info: …"; normal and verbose
void LogDetail(const std::string& message);   // "detail: …"; verbose only
void LogWarning(const std::string& message);  // "warning: …"; always

}  // namespace nrff
