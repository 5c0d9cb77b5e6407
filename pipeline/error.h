// Errors that end a stage, and the exit codes they map to.
//
// An error's text is one sentence that names the file or option, what was found, what was expected and what to do.
#pragma once

#include <stdexcept>
#include <string>

namespace nrff {

enum class ExitCode : int {
  kDone = 0,
  kUsage = 2,         // a command line that makes no sense
  kInput = 3,         // a capture, a file or a value that cannot be used
  kExternalTool = 4,  // COLMAP or ffmpeg missing, failing or hanging
  kResource = 5,      // memory, disk, GPU
  kCorrupt = 6,       // an artifact that is damaged or newer than this program
  kLocked = 7,        // another run holds the workspace
};

class Error : public std::runtime_error {
 public:
  Error(ExitCode code, const std::string& message) : std::runtime_error(message), code_(code) {}
  ExitCode code() const { return code_; }

 private:
  ExitCode code_;
};

inline Error UsageError(const std::string& message) { return {ExitCode::kUsage, message}; }
inline Error InputError(const std::string& message) { return {ExitCode::kInput, message}; }
inline Error ExternalToolError(const std::string& message) { return {ExitCode::kExternalTool, message}; }
inline Error ResourceError(const std::string& message) { return {ExitCode::kResource, message}; }
inline Error CorruptError(const std::string& message) { return {ExitCode::kCorrupt, message}; }
inline Error LockedError(const std::string& message) { return {ExitCode::kLocked, message}; }

}  // namespace nrff
