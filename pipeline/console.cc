#include "pipeline/console.h"

#include <string_view>

#include "pipeline/files.h"
#include "pipeline/progress.h"

namespace nrff {

bool IsShown(const std::string& line, Verbosity verbosity) {
  const auto is = [&](std::string_view severity) { return line.compare(0, severity.size(), severity) == 0; };
  if (is("error: ")) return false;  // told when the stage ends
  if (is("warning: ") || verbosity == Verbosity::kVerbose) return true;
  return is("info: ") && verbosity == Verbosity::kNormal;
}

std::string DecisionText(const Decision& decision) {
  return (decision.needed ? "needed: " : "left out: ") + decision.feature + " — " + decision.evidence + "; " +
         decision.reason;
}

Console::Console(std::ostream& out, std::function<int()> columns, Verbosity verbosity,
                 std::map<std::string, Workspace> workspaces)
    : view_(out, std::move(columns)), verbosity_(verbosity), workspaces_(std::move(workspaces)) {}

std::string Console::Label(const Node& node) const { return workspaces_.size() > 1 ? node.id() : node.stage; }

void Console::OnStart(const Node& node, const std::string& reason) {
  if (verbosity_ == Verbosity::kQuiet) return;
  view_.Print(Label(node) + ": runs, since it " + reason);
  view_.Begin(Label(node));
}

void Console::OnLine(const Node& node, const std::string& line) {
  if (IsShown(line, verbosity_)) view_.Print(Label(node) + ": " + EscapePath(line));
}

void Console::OnProgress(const Node& node, const ProgressUpdate& update) {
  if (verbosity_ != Verbosity::kQuiet) view_.Update(Label(node), update);
}

void Console::OnEnd(const Node& node, const Outcome& outcome, const std::optional<Manifest>& manifest) {
  const Workspace& workspace = workspaces_.at(node.branch);
  const std::string label = Label(node);
  view_.End(label);
  if (outcome.state == Outcome::kNotRun) return;
  workspace.Record(node.stage, {outcome.state == Outcome::kReused, outcome.job.exit_code, outcome.job.error});
  if (outcome.state == Outcome::kFailed) {
    view_.Print(label + ": failed: " + outcome.job.error);
    view_.Print(label + ": all it said is in " + EscapePath(node.log));
    return;
  }
  if (verbosity_ == Verbosity::kQuiet) return;
  if (outcome.state == Outcome::kReused) return view_.Print(label + ": reused");
  view_.Print(label + ": done in " + FormatSeconds(outcome.job.seconds) + ", " +
              FormatBytes(static_cast<double>(outcome.job.peak_memory_bytes)) + " at most");
  for (const Decision& decision : manifest->decisions) view_.Print(label + ": " + DecisionText(decision));
}

void Console::Tick() {
  if (verbosity_ != Verbosity::kQuiet) view_.Tick();
}

}  // namespace nrff
