// manifest.json of an artifact.
#include "pipeline/manifest.h"
#include "tests/fuzz/fuzz.h"

namespace nrff::fuzz {

std::vector<std::string> Seeds() {
  Manifest manifest;
  manifest.kind = "pose";
  manifest.producer = "nrff-pose";
  manifest.version = "0.3.0";
  manifest.params = {{"undistortion", "on"}};
  manifest.inputs = {{"ingest", "00", 0}};
  manifest.outputs = {{"scene.json", "99", 12}, {"images%20u8", "98", 0}};
  manifest.facts = {{"n_points", 3}, {"unregistered", {"a.jpg"}}};
  manifest.decisions = {{"sfm", false, "poses are given", "none", "poses are known"}};
  manifest.seconds = 1.5;
  manifest.peak_memory_bytes = uint64_t{1} << 33;
  manifest.host = {{"cores", 2}};
  return {Json(manifest).dump(1)};
}

}  // namespace nrff::fuzz

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace nrff;  // NOLINT(google-build-using-namespace)
  const std::filesystem::path file = fuzz::Folder() / kManifestName;
  fuzz::Write(kManifestName, {reinterpret_cast<const char*>(data), size});
  const auto read = [&] { return ReadManifest(fuzz::Folder()).value(); };
  const auto manifest = fuzz::ParseOrError(file, read);
  if (!manifest) return 0;
  const Json read_file = ReadJson(file);
  fuzz::RequireKept(read_file["facts"], manifest->facts);
  fuzz::RequireKept(read_file["outputs"], manifest->outputs);
  static_cast<void>(PayloadDamage(fuzz::Folder(), *manifest));
  WriteJson(file, *manifest);
  fuzz::Require(Json(read()) == Json(*manifest), "a manifest that is written is read as it was");
  return 0;
}
