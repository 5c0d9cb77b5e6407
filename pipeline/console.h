// What a person sees of a run, and the notes on it that are kept in the workspaces.
#pragma once

#include <map>
#include <ostream>
#include <string>

#include "pipeline/log.h"
#include "pipeline/progress_view.h"
#include "pipeline/scheduler.h"
#include "pipeline/workspace.h"

namespace nrff {

// Writes lines and bars to `out` and every stage's outcome to its workspace (StageRecord).
class Console : public RunObserver {
 public:
  // `workspaces`: by branch. The branch's name is shown where there are several.
  Console(std::ostream& out, std::function<int()> columns, Verbosity verbosity,
          std::map<std::string, Workspace> workspaces);

  void OnStart(const Node& node, const std::string& reason) override;
  void OnLine(const Node& node, const std::string& line) override;
  void OnProgress(const Node& node, const ProgressUpdate& update) override;
  void OnEnd(const Node& node, const Outcome& outcome, const std::optional<Manifest>& manifest) override;
  void Tick();

 private:
  std::string Label(const Node& node) const;

  ProgressView view_;
  Verbosity verbosity_;
  std::map<std::string, Workspace> workspaces_;
};

// Whether a stage's log line is to be shown, by its severity (log.h).
bool IsShown(const std::string& line, Verbosity verbosity);

// "left out: undistortion — largest displacement 0.03 px; the lens moves no pixel visibly"
std::string DecisionText(const Decision& decision);

}  // namespace nrff
