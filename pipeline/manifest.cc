#include "pipeline/manifest.h"

#include <sys/resource.h>
#include <sys/utsname.h>
#include <unistd.h>

#include <algorithm>
#include <fstream>

#include "pipeline/error.h"
#include "pipeline/files.h"

namespace nrff {
namespace fs = std::filesystem;
namespace {

constexpr char kPartialState[] = "partial.json";  // {key, seconds}: whose attempt a partial directory holds

std::string CpuName() {
  std::ifstream cpuinfo("/proc/cpuinfo");
  for (std::string line; std::getline(cpuinfo, line);) {
    if (line.starts_with("model name")) {
      const size_t colon = line.find(": ");
      if (colon != std::string::npos) return line.substr(colon + 2);
    }
  }
  return "unknown";
}

// Of this process and, as the largest single one, of its children.
uint64_t PeakMemoryBytes() {
  uint64_t peak = 0;
  for (const int who : {RUSAGE_SELF, RUSAGE_CHILDREN}) {
    rusage usage{};
    getrusage(who, &usage);
    peak = std::max(peak, static_cast<uint64_t>(usage.ru_maxrss) * 1024);
  }
  return peak;
}

std::vector<HashedPath> HashedPathsAt(const Json& json, const char* key, const std::string& where) {
  std::vector<HashedPath> paths;
  for (const Json& item : Get<std::vector<Json>>(json, key, where)) {
    paths.push_back({Get<std::string>(item, "path", where), Get<std::string>(item, "hash", where),
                     Get<uint64_t>(item, "size_bytes", where)});
  }
  return paths;
}

std::string AttemptKey(const Manifest& manifest) {
  return HashBytes(Json{manifest.kind, manifest.version, manifest.params, manifest.inputs}.dump());
}

}  // namespace

Json ThisHost() {
  utsname name{};
  uname(&name);
  return {
      {"cpu", CpuName()},
      {"cores", sysconf(_SC_NPROCESSORS_ONLN)},
      {"memory_bytes", static_cast<uint64_t>(sysconf(_SC_PHYS_PAGES)) * static_cast<uint64_t>(sysconf(_SC_PAGE_SIZE))},
      {"os", std::string(name.sysname) + " " + name.release}};
}

std::string Version() { return NRFF_VERSION; }

std::string Manifest::ContentHash() const {
  std::string listing;
  for (const HashedPath& output : outputs) listing += output.path + '\n' + output.hash + '\n';
  return HashBytes(listing);
}

void to_json(Json& json, const HashedPath& value) {
  json = {{"path", value.path}, {"hash", value.hash}, {"size_bytes", value.size_bytes}};
}

void to_json(Json& json, const Manifest& value) {
  json = {{"schema_version", kManifestSchemaVersion},
          {"kind", value.kind},
          {"producer", value.producer},
          {"version", value.version},
          {"params", value.params},
          {"inputs", value.inputs},
          {"outputs", value.outputs},
          {"facts", value.facts},
          {"decisions", value.decisions},
          {"seconds", value.seconds},
          {"peak_memory_bytes", value.peak_memory_bytes},
          {"host", value.host}};
}

std::optional<Manifest> ReadManifest(const fs::path& artifact_dir) {
  const fs::path path = artifact_dir / kManifestName;
  std::error_code error;
  if (!fs::exists(path, error)) return std::nullopt;
  const Json json = ReadJson(path);
  const std::string where = EscapePath(path);
  CheckSchemaVersion(json, kManifestSchemaVersion, where);
  Manifest manifest;
  manifest.kind = Get<std::string>(json, "kind", where);
  manifest.producer = Get<std::string>(json, "producer", where);
  manifest.version = Get<std::string>(json, "version", where);
  manifest.params = Get<Params>(json, "params", where);
  manifest.inputs = HashedPathsAt(json, "inputs", where);
  manifest.outputs = HashedPathsAt(json, "outputs", where);
  manifest.facts = Get<Json>(json, "facts", where);
  manifest.decisions = Get<std::vector<Decision>>(json, "decisions", where);
  manifest.seconds = Get<double>(json, "seconds", where);
  manifest.peak_memory_bytes = Get<uint64_t>(json, "peak_memory_bytes", where);
  manifest.host = Get<Json>(json, "host", where);
  return manifest;
}

std::string PayloadDamage(const fs::path& artifact_dir, const Manifest& manifest) {
  for (const HashedPath& output : manifest.outputs) {
    std::error_code error;
    const uint64_t size = fs::file_size(artifact_dir / UnescapePath(output.path), error);
    if (error) return "/" + output.path + " is missing";
    if (size != output.size_bytes) {
      return "/" + output.path + " has " + std::to_string(size) + " bytes instead of " +
             std::to_string(output.size_bytes);
    }
  }
  return {};
}

Manifest RequireArtifact(const fs::path& artifact_dir, const std::string& kind) {
  std::optional<Manifest> manifest = ReadManifest(artifact_dir);
  if (!manifest) {
    throw InputError(EscapePath(artifact_dir) + " holds no finished " + kind + " artifact (no " + kManifestName +
                     "): run the " + kind + " stage first");
  }
  if (manifest->kind != kind) {
    throw InputError(EscapePath(artifact_dir) + " is an artifact of the stage " + manifest->kind +
                     ", expected one of " + kind);
  }
  const std::string damage = PayloadDamage(artifact_dir, *manifest);
  if (!damage.empty()) {
    throw CorruptError(EscapePath(artifact_dir) + damage + ": run the " + kind + " stage again with --force");
  }
  return *manifest;
}

HashedPath ArtifactInput(const fs::path& artifact_dir, const Manifest& manifest) {
  fs::path dir = fs::absolute(artifact_dir).lexically_normal();
  if (!dir.has_filename()) dir = dir.parent_path();
  // By stage, not by place: a workspace that is moved stays fresh.
  return {EscapePath(dir.filename()), manifest.ContentHash(), 0};
}

ArtifactWriter::ArtifactWriter(std::string kind, const fs::path& out, Params params, std::vector<HashedPath> inputs,
                               Partial partial)
    : out_(fs::absolute(out).lexically_normal()), start_(std::chrono::steady_clock::now()) {
  if (!out_.has_filename()) out_ = out_.parent_path();
  dir_ = out_.native() + ".partial";
  manifest_.kind = std::move(kind);
  manifest_.producer = fs::read_symlink("/proc/self/exe").filename();
  manifest_.version = Version();
  manifest_.params = std::move(params);
  manifest_.inputs = std::move(inputs);

  const std::string key = AttemptKey(manifest_);
  const fs::path state_path = dir_ / kPartialState;
  std::error_code error;
  if (partial == kKeepPartial && fs::exists(state_path, error)) {
    try {
      const Json state = ReadJson(state_path);
      resumed_ = state.at("key") == key;
      seconds_before_ = state.at("seconds").get<double>();
    } catch (const std::exception&) {
      resumed_ = false;  // an attempt that cannot be identified is not gone on with
    }
  }
  if (resumed_) {
    RemoveTemporaries(dir_);  // half-written files of the attempt that was killed are no part of the artifact
    return;
  }
  seconds_before_ = 0;
  fs::remove_all(dir_, error);
  fs::create_directories(dir_, error);
  if (error) throw ResourceError("cannot create " + EscapePath(dir_) + ": " + error.message());
  WriteJson(state_path, {{"key", key}, {"seconds", 0.0}});
}

double ArtifactWriter::SecondsSoFar() const {
  return seconds_before_ + std::chrono::duration<double>(std::chrono::steady_clock::now() - start_).count();
}

void ArtifactWriter::AddDecision(const Decision& decision) {
  std::erase_if(manifest_.decisions, [&](const Decision& earlier) { return earlier.feature == decision.feature; });
  manifest_.decisions.push_back(decision);
}

void ArtifactWriter::SaveSeconds() const {
  WriteJson(dir_ / kPartialState, {{"key", AttemptKey(manifest_)}, {"seconds", SecondsSoFar()}});
}

void ArtifactWriter::Commit() {
  std::vector<fs::path> files;
  for (const std::string& output : outputs_) {
    const fs::path path = dir_ / output;
    if (fs::is_directory(path)) {
      for (const auto& entry : fs::recursive_directory_iterator(path)) {
        if (entry.is_regular_file()) files.push_back(entry.path());
      }
    } else {
      files.push_back(path);
    }
  }
  std::sort(files.begin(), files.end(), [](const fs::path& a, const fs::path& b) { return a.native() < b.native(); });
  files.erase(std::unique(files.begin(), files.end()), files.end());
  for (const fs::path& file : files) {
    SyncPath(file);
    manifest_.outputs.push_back({EscapePath(file.lexically_relative(dir_)), HashFile(file), fs::file_size(file)});
  }
  manifest_.seconds = SecondsSoFar();
  manifest_.peak_memory_bytes = PeakMemoryBytes();
  manifest_.host = ThisHost();
  fs::remove(dir_ / kPartialState);
  WriteJson(dir_ / kManifestName, manifest_);
  ReplaceDirectory(dir_, out_);
}

}  // namespace nrff
