// Runs a graph: whatever is stale, inputs first, side by side where they do not depend on each other and the machine
// has room. A node that fails stops only what depends on it.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "pipeline/executor.h"
#include "pipeline/graph.h"

namespace nrff {

struct Machine {
  int cores = 1;
  uint64_t memory_bytes = 0;
};

Machine ThisMachine();  // memory: what is available now

struct Outcome {
  enum State { kReused, kRan, kFailed, kNotRun };
  State state = kNotRun;
  std::string reason;  // kRan, kFailed: why it had to run; kNotRun: what kept it from running
  JobResult job;       // kRan, kFailed
};

// Told what happens, in the thread that runs the graph.
class RunObserver {
 public:
  virtual ~RunObserver() = default;
  virtual void OnStart(const Node& node, const std::string& reason) = 0;
  virtual void OnLine(const Node& node, const std::string& line) = 0;
  virtual void OnProgress(const Node& node, const ProgressUpdate& update) = 0;
  // `manifest`: of the artifact, when there is one to be used (kReused, kRan).
  virtual void OnEnd(const Node& node, const Outcome& outcome, const std::optional<Manifest>& manifest) = 0;
};

// Outcomes by the nodes' index in the graph. When a signal asks to stop (Executor::StopSignal), nothing new is started.
std::vector<Outcome> RunGraph(Graph& graph, Executor& executor, const Machine& machine, RunObserver& observer);

}  // namespace nrff
