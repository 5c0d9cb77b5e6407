// The project's executables as tests run them: as processes, with what they printed kept.
#pragma once

#include <sys/types.h>

#include <filesystem>
#include <map>
#include <string>
#include <vector>

namespace nrff {

struct ProgramOptions {
  std::map<std::string, std::string> environment = {};  // set in addition to the test's own
  uint64_t file_size_limit_bytes = 0;                   // RLIMIT_FSIZE, with SIGXFSZ ignored; 0: none
  double limit_seconds = 240;                           // then it is killed
};

struct ProgramResult {
  int exit_code = -1;  // 128 + n when signal n ended it
  std::string out, err;
  double seconds = 0;

  // The lines of `err` that begin with "error: ", without that.
  std::vector<std::string> Errors() const;
};

// A running program, from when it is constructed. It leads a session of its own, which everything that it starts
// belongs to.
class Program {
 public:
  // `command`: a program of the build by name ("nrff-ingest") or a path; arguments may hold any byte.
  Program(const std::vector<std::string>& command, const ProgramOptions& options);
  ~Program();  // kills the session if it was not waited for
  Program(const Program&) = delete;
  Program& operator=(const Program&) = delete;

  pid_t pid() const { return pid_; }
  ProgramResult Wait();
  // kill -9 of everything in the session, or of the program alone.
  void KillSession() const;
  void KillAlone() const;
  // The processes of the session that have not ended.
  std::vector<pid_t> Session() const;

 private:
  pid_t pid_ = -1;
  bool waited_ = false;
  double limit_seconds_;
  double start_seconds_;
  std::filesystem::path output_;  // a directory with `out` and `err`
};

ProgramResult RunProgram(const std::vector<std::string>& command, const ProgramOptions& options = {});

}  // namespace nrff
