#include "pipeline/workspace.h"

#include <fcntl.h>
#include <sys/file.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <utility>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr int kMarkerSchemaVersion = 1;
constexpr char kReportFolder[] = "report";  // of the joint report, beside the workspaces

fs::path RecordPath(const Workspace& workspace, const std::string& stage) {
  return workspace.root() / "logs" / (stage + ".json");
}

fs::path LockPath(const Workspace& workspace) { return workspace.root() / "lock"; }

int ReadHolder(int descriptor) {
  char text[32] = {};
  const ssize_t n = pread(descriptor, text, sizeof text - 1, 0);
  return n > 0 ? std::atoi(text) : 0;
}

void MakeDirectories(const fs::path& path) {
  std::error_code error;
  fs::create_directories(path, error);
  if (error) throw ResourceError("cannot make the folder " + EscapePath(path) + ": " + error.message());
}

bool IsEmptyOrAbsent(const fs::path& path) {
  std::error_code error;
  return !fs::exists(path, error) || (fs::is_directory(path, error) && fs::is_empty(path, error));
}

}  // namespace

bool Workspace::Exists() const {
  std::error_code error;
  return fs::is_regular_file(root_ / kWorkspaceMarker, error);
}

Workspace::Marker Workspace::ReadMarker() const {
  if (!Exists()) {
    throw InputError(EscapePath(root_) + " is not a workspace: it has no " + kWorkspaceMarker +
                     "; give a folder made by `nrff run`");
  }
  const fs::path path = root_ / kWorkspaceMarker;
  const Json json = ReadJson(path);
  CheckSchemaVersion(json, kMarkerSchemaVersion, EscapePath(path));
  return {UnescapePath(Get<std::string>(json, "capture", EscapePath(path))),
          Get<Params>(json, "options", EscapePath(path))};
}

void Workspace::Claim(const fs::path& capture) const {
  if (Exists()) {
    const fs::path owner = ReadMarker().capture;
    if (owner != capture) {
      throw InputError(EscapePath(root_) + " is the workspace of " + EscapePath(owner) + ", not of " +
                       EscapePath(capture) + ": give another --workspace");
    }
    return;
  }
  if (!IsEmptyOrAbsent(root_)) {
    throw InputError(EscapePath(root_) + " holds files and is not a workspace: give a new folder as --workspace");
  }
  MakeDirectories(root_);
  WriteMarker({capture, {}});
}

void Workspace::WriteMarker(const Marker& marker) const {
  MakeDirectories(root_ / "logs");
  WriteJson(root_ / kWorkspaceMarker, {{"schema_version", kMarkerSchemaVersion},
                                       {"capture", EscapePath(marker.capture)},
                                       {"version", Version()},
                                       {"options", marker.options}});
}

namespace {

void Link(const fs::path& from, const fs::path& to) {
  std::error_code error;
  if (fs::is_directory(from, error)) {
    MakeDirectories(to);
    for (const fs::directory_entry& entry : fs::directory_iterator(from))
      Link(entry.path(), to / entry.path().filename());
    return;
  }
  fs::create_hard_link(from, to, error);
  if (error) fs::copy_file(from, to, error);
  if (error) throw ResourceError("cannot keep " + EscapePath(from) + " as " + EscapePath(to) + ": " + error.message());
}

}  // namespace

bool Workspace::HasBase(const std::string& stage) const {
  std::error_code error;
  return fs::is_regular_file(Base(stage) / kManifestName, error);
}

void Workspace::KeepBase(const KeptFiles& kept) const {
  const fs::path base = root_ / kBaseFolder, fresh = root_ / (std::string(kBaseFolder) + ".partial");
  std::error_code error;
  fs::remove_all(fresh, error);
  for (const auto& [stage, files] : kept) {
    MakeDirectories(fresh / stage);
    Link(Artifact(stage) / kManifestName, fresh / stage / kManifestName);
    for (const std::string& file : files) Link(Artifact(stage) / file, fresh / stage / file);
  }
  ReplaceDirectory(fresh, base);
}

void Workspace::ForgetBase() const {
  std::error_code error;
  fs::remove_all(root_ / kBaseFolder, error);
  if (error) throw ResourceError("cannot remove " + EscapePath(root_ / kBaseFolder) + ": " + error.message());
}

Manifest Workspace::Require(const std::string& stage) const {
  if (!ReadManifest(Artifact(stage))) {
    throw InputError(EscapePath(root_) + " has no finished " + stage + " yet: `nrff run " + EscapePath(root_) +
                     "` makes it");
  }
  return RequireArtifact(Artifact(stage), stage);
}

void Workspace::Record(const std::string& stage, const StageRecord& record) const {
  WriteJson(RecordPath(*this, stage),
            {{"reused", record.reused}, {"exit_code", record.exit_code}, {"error", record.error}});
}

std::optional<StageRecord> Workspace::LastRecord(const std::string& stage) const {
  const fs::path path = RecordPath(*this, stage);
  std::error_code error;
  if (!fs::exists(path, error)) return {};
  try {
    const Json json = ReadJson(path);
    const std::string where = EscapePath(path);
    return StageRecord{Get<bool>(json, "reused", where), Get<int>(json, "exit_code", where),
                       Get<std::string>(json, "error", where)};
  } catch (const Error&) {
    return {};  // only a note for people
  }
}

WorkspaceLock::WorkspaceLock(const Workspace& workspace) {
  const fs::path path = LockPath(workspace);
  descriptor_ = open(path.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0666);
  if (descriptor_ < 0) throw ResourceError("cannot write " + EscapePath(path) + ": " + std::strerror(errno));
  if (flock(descriptor_, LOCK_EX | LOCK_NB) == 0) {
    const std::string holder = std::to_string(getpid()) + "\n";
    if (ftruncate(descriptor_, 0) != 0 || pwrite(descriptor_, holder.data(), holder.size(), 0) < 0) {
      const std::string reason = std::strerror(errno);
      close(descriptor_);
      throw ResourceError("cannot write " + EscapePath(path) + ": " + reason);
    }
    return;
  }
  const int holder = ReadHolder(descriptor_);
  close(std::exchange(descriptor_, -1));
  if (holder == getppid()) return;
  throw LockedError(EscapePath(workspace.root()) + " is in use by process " + std::to_string(holder) +
                    ": wait until that ends, or end it, and run again");
}

WorkspaceLock::~WorkspaceLock() {
  if (descriptor_ >= 0) close(descriptor_);
}

WorkspaceLock::WorkspaceLock(WorkspaceLock&& other) noexcept : descriptor_(std::exchange(other.descriptor_, -1)) {}

std::optional<int> WorkspaceLock::Holder(const Workspace& workspace) {
  const int descriptor = open(LockPath(workspace).c_str(), O_RDONLY | O_CLOEXEC);
  if (descriptor < 0) return {};
  std::optional<int> holder;
  if (flock(descriptor, LOCK_SH | LOCK_NB) != 0) holder = ReadHolder(descriptor);
  close(descriptor);
  return holder;
}

fs::path CapturePath(const fs::path& given) {
  std::error_code error;
  fs::path path = fs::canonical(given, error);
  if (error) throw InputError("cannot read the capture " + EscapePath(given) + ": " + error.message());
  return path;
}

std::string CaptureName(const fs::path& capture) {
  std::string safe = EscapePath(CaptureFolderName(capture));
  std::replace_if(
      safe.begin(), safe.end(), [](char c) { return std::strchr(" %/\\:*?\"'<>|", c) != nullptr; }, '_');
  safe.erase(0, safe.find_first_not_of(".-"));
  return safe.empty() ? "capture" : safe;
}

Workspace WorkspaceFor(const fs::path& capture, const fs::path& folder, const std::set<fs::path>& taken) {
  const std::string name = CaptureName(capture);
  for (int n = 1;; ++n) {
    Workspace workspace(folder / (n == 1 ? name : name + "-" + std::to_string(n)));
    if (workspace.root().filename() == kReportFolder || taken.contains(workspace.root())) continue;
    if (!workspace.Exists() || workspace.ReadMarker().capture == capture) return workspace;
  }
}

std::vector<Workspace> FindWorkspaces(const fs::path& path) {
  if (Workspace(path).Exists()) return {Workspace(path)};
  std::vector<Workspace> found;
  std::error_code error;
  for (const fs::directory_entry& entry : fs::directory_iterator(path, error)) {
    if (Workspace(entry.path()).Exists()) found.emplace_back(entry.path());
  }
  if (found.empty()) {
    throw InputError(EscapePath(path) + " is not a workspace and holds none: give a folder made by `nrff run`");
  }
  std::sort(found.begin(), found.end(), [](const Workspace& a, const Workspace& b) { return a.root() < b.root(); });
  return found;
}

}  // namespace nrff
