// Child processes: one command line run to its end, watched, logged, and never outliving its parent.
//
// The child leads a process group of its own, so that what it starts in turn is stopped with it, and the kernel kills
// it when the thread that called RunProcess dies (PR_SET_PDEATHSIG). Its standard input is /dev/null. RunProcess may
// be called from several threads at once.
#pragma once

#include <atomic>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <map>
#include <string>
#include <string_view>
#include <vector>

namespace nrff {

struct ProcessOptions {
  std::vector<std::string> command;                // program (looked up in PATH) and arguments; any bytes
  std::map<std::string, std::string> environment;  // set in addition to this process's own
  std::filesystem::path log;  // stdout and stderr are appended to it, after the command line itself
  // Called for every complete line of stdout and stderr ('\n' or '\r' ends one), without its end.
  std::function<void(std::string_view line)> on_line;
  // Called for every line the child writes to the descriptor whose number it finds in NRFF_PROGRESS_FD. Without a
  // callback the child does not see that variable.
  std::function<void(std::string_view line)> on_progress;
  double limit_seconds = 0;        // the longest it may take; 0: no limit
  double stall_limit_seconds = 0;  // the longest it may neither print nor use any processor time; 0: no limit
  const std::atomic<bool>* cancel = nullptr;  // becomes true: the group is asked to end, then killed
};

struct ProcessResult {
  enum class End { kExited, kSignalled, kTimeLimit, kStalled, kCancelled };
  End end = End::kExited;
  int exit_code = 0;                    // kExited
  int signal = 0;                       // otherwise: what ended it
  double seconds = 0;                   // wall clock
  uint64_t peak_memory_bytes = 0;       // of the largest process waited for
  std::vector<std::string> last_lines;  // of its output, at most 12, oldest first

  bool Succeeded() const { return end == End::kExited && exit_code == 0; }
};

// Throws ExternalToolError when the program cannot be started (not found, not executable) and ResourceError when the
// log cannot be written or no process can be made. How the program itself ended is in the result.
ProcessResult RunProcess(const ProcessOptions& options);

// "exited with status 1", "was ended by signal 9 (Killed)", "was stopped after 30 s without output or processor use", …
std::string DescribeEnd(const ProcessResult& result);

}  // namespace nrff
