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

std::string MissingPayload(const fs::path& artifact, const Manifest& manifest) {
  for (const HashedPath& output : manifest.outputs) {
    std::error_code error;
    const uint64_t size_bytes = fs::file_size(artifact / UnescapePath(output.path), error);
    if (error) return "has lost " + output.path;
    if (size_bytes != output.size_bytes) return "has a " + output.path + " of another size than was written";
  }
  return {};
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
  state.problem = MissingPayload(artifact, *state.manifest);
  if (!state.problem.empty()) state.manifest.reset();
  return state;
}

std::string RealDisk::HashSource(const fs::path& source) { return HashTree(source); }

}  // namespace nrff
