// Artifacts: a directory with a payload and a `manifest.json`, written last. A directory without a valid manifest does
// not exist as far as the graph is concerned.
//
// A stage works in `<out>.partial` and, when all is written, exchanges it for `<out>`, so that a stage that fails or
// is killed leaves the last complete artifact untouched.
#pragma once

#include <chrono>
#include <filesystem>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/json.h"
#include "pipeline/needs.h"

namespace nrff {

inline constexpr int kManifestSchemaVersion = 1;
inline constexpr char kManifestName[] = "manifest.json";

// Option name (without dashes) → value as given on the command line. Only what was given: defaults belong to the
// program's version.
using Params = std::map<std::string, std::string>;

struct HashedPath {
  std::string path;  // escaped (EscapePath); inputs: as given or absolute; outputs: relative to the artifact
  std::string hash;
  uint64_t size_bytes = 0;
};

struct Manifest {
  std::string kind;      // "ingest", "sfm", "pose", "train", "render", "eval", "report", "rendering", "scoring",
                         // "refinement"
  std::string producer;  // executable, e.g. "nrff-train"
  std::string version;   // of the producer
  Params params;
  std::vector<HashedPath> inputs;
  std::vector<HashedPath> outputs;
  Json facts = Json::object();  // measured figures; may hold times: not part of the content hash
  std::vector<Decision> decisions;
  double seconds = 0;  // wall clock over all attempts that this artifact was made in
  uint64_t peak_memory_bytes = 0;
  Json host = Json::object();  // ThisHost() where it was made

  // Hash over outputs' (path, hash): equal for byte-identical payloads, whatever time they took.
  std::string ContentHash() const;
};

void to_json(Json& json, const HashedPath& value);
void to_json(Json& json, const Manifest& value);

// Nothing when there is no manifest; throws CorruptError when there is one that cannot be read or is too new.
std::optional<Manifest> ReadManifest(const std::filesystem::path& artifact_dir);

// What is wrong with the payload files the manifest names (missing, another size), to be read after the artifact's
// path: "/model.safetensors is missing". Empty when they are as written.
std::string PayloadDamage(const std::filesystem::path& artifact_dir, const Manifest& manifest);

// As ReadManifest, but absence or another kind is an InputError that says which stage to run; checks that the payload
// files are there with their sizes.
Manifest RequireArtifact(const std::filesystem::path& artifact_dir, const std::string& kind);

// The input entry for an artifact that another stage made: its path and ContentHash.
HashedPath ArtifactInput(const std::filesystem::path& artifact_dir, const Manifest& manifest);

// Writes one artifact.
//   ArtifactWriter artifact("train", out, params, inputs, ArtifactWriter::kKeepPartial);
//   ... write files below artifact.dir() ...
//   artifact.AddOutput("model.safetensors");
//   artifact.Commit();
class ArtifactWriter {
 public:
  enum Partial { kDiscardPartial, kKeepPartial };

  // Prepares `<out>.partial`. With kKeepPartial, what an interrupted attempt with the same producer version, params
  // and inputs left there is kept (`resumed()` is then true), so that the stage can go on from it.
  ArtifactWriter(std::string kind, const std::filesystem::path& out, Params params, std::vector<HashedPath> inputs,
                 Partial partial = kDiscardPartial);

  const std::filesystem::path& dir() const { return dir_; }  // `<out>.partial`
  bool resumed() const { return resumed_; }
  double SecondsSoFar() const;  // this attempt and, if resumed, those before it that called SaveSeconds

  Json& facts() { return manifest_.facts; }
  // One that is made again replaces the earlier one.
  void AddDecision(const Decision& decision);
  // Names a payload file or a directory (all files below it), relative to dir(). Files not named stay in the artifact
  // but are not part of its content hash (logs).
  void AddOutput(const std::string& relative_path) { outputs_.push_back(relative_path); }
  // Remembers the time spent so far in the partial directory (call with every checkpoint).
  void SaveSeconds() const;
  // Hashes outputs, writes the manifest, fsyncs and puts the directory in place.
  void Commit();

 private:
  Manifest manifest_;
  std::filesystem::path out_;
  std::filesystem::path dir_;
  std::vector<std::string> outputs_;
  bool resumed_ = false;
  double seconds_before_ = 0;
  std::chrono::steady_clock::time_point start_;
};

// The version every executable reports and records.
std::string Version();

// {cpu, cores, memory_bytes, os} of this machine.
Json ThisHost();

}  // namespace nrff
