#include "pipeline/scheduler.h"

#include <algorithm>
#include <fstream>
#include <map>
#include <thread>

#include "pipeline/error.h"

namespace nrff {
namespace {

class Scheduler {
 public:
  Scheduler(Graph& graph, Executor& executor, const Machine& machine, RunObserver& observer)
      : graph_(graph), executor_(executor), machine_(machine), observer_(observer) {}

  std::vector<Outcome> Run() {
    while (true) {
      while (StartWhatCan()) {
      }
      if (jobs_.empty()) break;
      TakeFinished();
    }
    return std::move(outcomes_);
  }

 private:
  enum class State { kPending, kRunning, kEnded };

  // One pass over the nodes; true when something changed, so that another pass may find more to do.
  bool StartWhatCan() {
    bool changed = false;
    for (size_t i = 0; i < graph_.nodes().size(); ++i) {  // grows while nodes end
      if (outcomes_.size() <= i) {
        outcomes_.resize(i + 1);
        states_.resize(i + 1, State::kPending);
      }
      if (states_[i] == State::kPending) changed |= Consider(i);
    }
    return changed;
  }

  bool Consider(size_t i) {
    const Node& node = graph_.nodes()[i];
    for (const std::string& input : node.inputs) {
      const size_t k = graph_.IndexOf(input);
      if (states_[k] != State::kEnded) return false;
      const Outcome::State state = outcomes_[k].state;
      if (state == Outcome::kReused || state == Outcome::kRan) continue;
      End(i,
          {Outcome::kNotRun, graph_.nodes()[k].stage + (state == Outcome::kFailed ? " failed" : " was not run"), {}});
      return true;
    }
    if (executor_.StopSignal() != 0) {
      End(i, {Outcome::kNotRun, "the run was stopped", {}});
      return true;
    }
    if (!HasRoomFor(node)) return false;
    try {
      const Verdict verdict = graph_.Examine(node);
      if (verdict.state == Verdict::kFresh) {
        End(i, {Outcome::kReused, {}, {}});
      } else if (node.when == When::kNever) {
        throw InputError(node.artifact.string() + " " + verdict.reason + ": run `nrff run` first");
      } else {
        Start(i, verdict.reason);
      }
    } catch (const Error& error) {
      Fail(i, {}, error);
    }
    return true;
  }

  // A node that asks for more than the machine has runs alone.
  bool HasRoomFor(const Node& node) const {
    if (jobs_.empty()) return true;
    int cores = node.cores;
    uint64_t memory_bytes = node.memory_bytes;
    for (const auto& [job, i] : jobs_) {
      cores += graph_.nodes()[i].cores;
      memory_bytes += graph_.nodes()[i].memory_bytes;
    }
    return cores <= machine_.cores && memory_bytes <= machine_.memory_bytes;
  }

  void Start(size_t i, const std::string& reason) {
    const Node& node = graph_.nodes()[i];
    Job job{node.command, node.log, [this, &node](const std::string& line) { observer_.OnLine(node, line); },
            [this, &node](const ProgressUpdate& update) { observer_.OnProgress(node, update); }};
    observer_.OnStart(node, reason);
    outcomes_[i].reason = reason;
    states_[i] = State::kRunning;
    jobs_[executor_.Start(std::move(job))] = i;
  }

  void TakeFinished() {
    const Executor::Finished finished = executor_.Wait();
    const size_t i = jobs_.at(finished.job);
    jobs_.erase(finished.job);
    const Node& node = graph_.nodes()[i];
    graph_.Forget(node);
    Outcome outcome{Outcome::kRan, outcomes_[i].reason, finished.result};
    if (finished.result.exit_code != 0) {
      outcome.state = Outcome::kFailed;
      return End(i, outcome);
    }
    try {
      const ArtifactState& artifact = graph_.Artifact(node);
      if (!artifact.manifest) throw CorruptError("ended without an error, but its artifact " + artifact.problem);
      const std::string why_stale = graph_.WhyStale(node);
      if (!why_stale.empty()) {
        observer_.OnLine(node, "warning: what " + node.stage + " made will not be used again: it " + why_stale);
      }
      End(i, outcome);
    } catch (const Error& error) {
      Fail(i, outcome, error);
    }
  }

  void Fail(size_t i, Outcome outcome, const Error& error) {
    outcome.state = Outcome::kFailed;
    outcome.job.exit_code = static_cast<int>(error.code());
    outcome.job.error = error.what();
    End(i, outcome);
  }

  void End(size_t i, const Outcome& outcome) {
    const Node& node = graph_.nodes()[i];
    states_[i] = State::kEnded;
    outcomes_[i] = outcome;
    const bool usable = outcome.state == Outcome::kReused || outcome.state == Outcome::kRan;
    const std::optional<Manifest> manifest = usable ? graph_.Artifact(node).manifest : std::nullopt;
    observer_.OnEnd(node, outcome, manifest);
    if (!manifest || !node.expand) return;
    for (Node& next : node.expand(manifest->facts)) graph_.Add(std::move(next));
  }

  Graph& graph_;
  Executor& executor_;
  const Machine machine_;
  RunObserver& observer_;
  std::vector<State> states_;      // by node
  std::vector<Outcome> outcomes_;  // by node
  std::map<int, size_t> jobs_;     // running: job → node
};

}  // namespace

Machine ThisMachine() {
  Machine machine;
  machine.cores = static_cast<int>(std::max(1u, std::thread::hardware_concurrency()));
  std::ifstream meminfo("/proc/meminfo");
  for (std::string name, unit; meminfo >> name;) {
    if (name != "MemAvailable:") continue;
    uint64_t kibibytes = 0;
    meminfo >> kibibytes;
    machine.memory_bytes = kibibytes << 10;
  }
  return machine;
}

std::vector<Outcome> RunGraph(Graph& graph, Executor& executor, const Machine& machine, RunObserver& observer) {
  return Scheduler(graph, executor, machine, observer).Run();
}

}  // namespace nrff
