// What runs the command lines of a graph. An interface, so that the graph is run in tests without processes, and on
// other machines than this one by another implementation.
#pragma once

#include <cstdint>
#include <filesystem>
#include <functional>
#include <string>
#include <vector>

#include "pipeline/progress.h"

namespace nrff {

struct Job {
  std::vector<std::string> command;  // program and arguments
  std::filesystem::path log;         // gets what it prints, replacing what is there; empty: nowhere
  // Both are called by Executor::Wait, never from another thread.
  std::function<void(const std::string& line)> on_line;
  std::function<void(const ProgressUpdate&)> on_progress;
};

struct JobResult {
  int exit_code = 0;  // 128 + n when signal n ended it
  std::string error;  // one sentence saying why it failed: its last "error: …" line; empty when it did not
  double seconds = 0;
  uint64_t peak_memory_bytes = 0;
};

class Executor {
 public:
  struct Finished {
    int job = 0;
    JobResult result;
  };

  virtual ~Executor() = default;
  // Returns the job's number. A job that cannot be started is one that finishes with an error.
  virtual int Start(Job job) = 0;
  // Blocks until a job is finished, calling the jobs' callbacks meanwhile. Requires a job that was started and not
  // yet returned.
  virtual Finished Wait() = 0;
  // The signal that asked this program to stop while jobs ran, 0: none. All jobs have been told to end then.
  virtual int StopSignal() const = 0;
};

// Starts the job and waits for it. Requires that nothing else runs on the executor.
JobResult RunJob(Executor& executor, Job job);

}  // namespace nrff
