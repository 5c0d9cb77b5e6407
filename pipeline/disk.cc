#include "pipeline/disk.h"

#include "pipeline/error.h"
#include "pipeline/files.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

bool MadeByNewerProgram(const fs::path& manifest_path) {
  try {
    return Get<int>(ReadJson(manifest_path), "schema_version", manifest_path.string()) > kManifestSchemaVersion;
  } catch (const Error&) {
    return false;
  }
}

}  // namespace

ArtifactState RealDisk::ReadArtifact(const fs::path& artifact) {
  ArtifactState state;
  try {
    state.manifest = ReadManifest(artifact);
  } catch (const Error& error) {
    if (MadeByNewerProgram(artifact / kManifestName)) throw;
    state.problem = std::string("has a damaged manifest: ") + error.what();
    return state;
  }
  if (!state.manifest) {
    fs::path partial = artifact;
    partial += ".partial";
    std::error_code ignored;
    state.problem = fs::exists(partial, ignored) ? "was begun but not finished" : "has not been made";
    return state;
  }
  const std::string damage = PayloadDamage(artifact, *state.manifest);
  if (!damage.empty()) {
    state.problem = "is damaged: " + artifact.filename().string() + damage;
    state.manifest.reset();
  }
  return state;
}

std::string RealDisk::HashSource(const fs::path& source) { return HashTree(source); }

}  // namespace nrff
