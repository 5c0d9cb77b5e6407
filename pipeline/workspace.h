// The folder that holds everything made from one capture (layout: ARCHITECTURE.md), and the lock on it.
//
//   nrff-workspace.json   {"schema_version", "capture", "version", "options"}: what makes a folder a workspace
//   logs/STAGE.log        what the stage printed when it last ran
//   logs/STAGE.json       how the stage fared in the last run (StageRecord)
#pragma once

#include <filesystem>
#include <optional>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "pipeline/extension.h"
#include "pipeline/manifest.h"

namespace nrff {

// How a stage fared in the last run that came to it.
struct StageRecord {
  bool reused = false;
  int exit_code = 0;
  std::string error;  // empty unless it failed
};

// Stages, and of each the names of files and folders in its artifact.
using KeptFiles = std::vector<std::pair<std::string, std::vector<std::string>>>;

class Workspace {
 public:
  explicit Workspace(std::filesystem::path root) : root_(std::move(root)) {}

  const std::filesystem::path& root() const { return root_; }
  std::filesystem::path Artifact(const std::string& stage) const { return root_ / stage; }
  std::filesystem::path Log(const std::string& stage) const { return root_ / "logs" / (stage + ".log"); }
  // What an earlier run made of fewer photos of the capture (extension.h).
  std::filesystem::path Base(const std::string& stage) const { return root_ / kBaseFolder / stage; }
  bool HasBase(const std::string& stage) const;
  // Makes base/ hold these files of finished stages and their manifests. Linked, not copied, where the disk can; what
  // base/ held before is replaced at once. Throws ResourceError.
  void KeepBase(const KeptFiles& kept) const;
  void ForgetBase() const;

  std::filesystem::path Report() const { return root_ / "report" / "report.html"; }

  bool Exists() const;
  struct Marker {
    std::filesystem::path capture;  // absolute
    Params options;                 // parameters given to the last run, for what looks at the workspace later
  };
  Marker ReadMarker() const;  // throws InputError when this is no workspace, CorruptError when the marker is damaged
  // Makes the folder a workspace of the capture if it is none. Throws InputError when it is one of another capture, or
  // holds files and is not a workspace.
  void Claim(const std::filesystem::path& capture) const;
  void WriteMarker(const Marker& marker) const;

  // The manifest of a finished stage. Throws InputError when it has not been made, CorruptError when it is damaged.
  Manifest Require(const std::string& stage) const;

  void Record(const std::string& stage, const StageRecord& record) const;
  std::optional<StageRecord> LastRecord(const std::string& stage) const;

 private:
  std::filesystem::path root_;
};

// Held by one process at a time, released by the kernel when that ends in whatever way. A process started by the
// holder takes part in its lock.
class WorkspaceLock {
 public:
  // Throws LockedError naming the process that holds it.
  explicit WorkspaceLock(const Workspace& workspace);
  ~WorkspaceLock();
  WorkspaceLock(WorkspaceLock&& other) noexcept;
  WorkspaceLock(const WorkspaceLock&) = delete;
  WorkspaceLock& operator=(const WorkspaceLock&) = delete;

  // The process that holds the workspace now.
  static std::optional<int> Holder(const Workspace& workspace);

 private:
  int descriptor_ = -1;
};

// The absolute path of a capture, links resolved. Throws InputError when there is nothing.
std::filesystem::path CapturePath(const std::filesystem::path& given);

// A folder's name for what is made from the capture: the capture's own, with awkward characters replaced.
std::string CaptureName(const std::filesystem::path& capture);

// The workspace of the capture in `folder`: `folder`/NAME, or NAME-2, … where that is `taken` or another capture's.
Workspace WorkspaceFor(const std::filesystem::path& capture, const std::filesystem::path& folder,
                       const std::set<std::filesystem::path>& taken);

// `path` itself if it is a workspace, else the workspaces in it, by name. Throws InputError when there are none.
std::vector<Workspace> FindWorkspaces(const std::filesystem::path& path);

}  // namespace nrff
