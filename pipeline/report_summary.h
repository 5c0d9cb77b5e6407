// What lies in a workspace, gathered for the report: the stages' manifests and records, and the summary made of them.
#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/json.h"
#include "pipeline/manifest.h"

namespace nrff {

struct StageState {
  std::string name;
  std::optional<Manifest> manifest;  // none: not made
  bool reused = false;               // taken as it was in the last run
  std::string error;                 // how it failed in the last run, or what is wrong with its artifact
};

struct WorkspaceState {
  std::filesystem::path root;      // absolute
  std::string name;                // of the capture
  std::vector<StageState> stages;  // that belong to the capture (no sfm when it brings its poses), without the report

  const StageState& Stage(const std::string& name) const;
  // Facts of a stage; an empty object when it has not been made.
  const Json& Facts(const std::string& stage) const;
};

// Throws nothing for what is missing or damaged.
WorkspaceState ReadWorkspace(const std::filesystem::path& workspace);

// summary.json (schema in report.h).
Json Summarise(const WorkspaceState& state);

// value[key], or null where `value` has no such key.
const Json& At(const Json& value, const char* key);

}  // namespace nrff
