#include "pipeline/report_summary.h"

#include <algorithm>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/report_warnings.h"
#include "pipeline/stages.h"
#include "pipeline/workspace.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr int kSummarySchemaVersion = 1;

StageState ReadStage(const Workspace& workspace, const std::string& name) {
  StageState stage;
  stage.name = name;
  if (const auto record = workspace.LastRecord(name)) {
    stage.reused = record->reused;
    stage.error = record->error;
  }
  try {
    stage.manifest = ReadManifest(workspace.Artifact(name));
  } catch (const Error& error) {
    if (stage.error.empty()) stage.error = error.what();
  }
  return stage;
}

// The first stage that failed; null when none did.
Json Failure(const WorkspaceState& state) {
  for (const StageState& stage : state.stages) {
    if (!stage.error.empty()) return {{"stage", stage.name}, {"error", stage.error}};
  }
  return nullptr;
}

Json Metrics(const WorkspaceState& state) {
  Json metrics = {{"psnr", nullptr}, {"ssim", nullptr}, {"lpips", nullptr}, {"n_images", 0}};
  const Json& facts = state.Facts("eval");
  for (const auto& [key, value] : facts.items()) {
    if (key != "protocol") metrics[key] = value;
  }
  return metrics;
}

// The rows of metrics.json with paths relative to the workspace.
Json Images(const WorkspaceState& state) {
  Json images = Json::array();
  if (!state.Stage("eval").manifest) return images;
  const fs::path folder = "eval";
  try {
    const Json metrics = ReadJson(state.root / folder / "metrics.json");
    for (const Json& row : At(metrics, "images")) {
      Json image = row;
      for (const char* key : {"rendered", "truth", "error"}) {
        image[key] = (folder / Get<std::string>(row, key, "metrics.json")).lexically_normal().string();
      }
      images.push_back(image);
    }
  } catch (const Error&) {
    return Json::array();  // its manifest still holds the means
  }
  return images;
}

Json Split(const WorkspaceState& state) {
  const Json &ingest = state.Facts("ingest"), &sfm = state.Facts("sfm"), &pose = state.Facts("pose");
  const bool posed = At(ingest, "posed") == true;
  return {{"rule", At(ingest, "split_rule")},
          {"train", At(ingest, "n_train")},
          {"test", At(ingest, "n_test")},
          {"registered", posed ? At(ingest, "n_images") : At(sfm, "n_registered")},
          {"registered_train", At(pose, "n_views_train")},
          {"registered_test", At(pose, "n_views_test")}};
}

Json Training(const StageState& train) {
  const Json& facts = train.manifest ? train.manifest->facts : Json::object();
  Json training = {{"seconds", At(facts, "seconds_training")}};
  for (const char* key : {"steps", "samples", "preset", "device", "threads", "n_parameters"}) {
    training[key] = At(facts, key);
  }
  training["curve"] = At(facts, "curve").is_array() ? At(facts, "curve") : Json::array();
  training["model_bytes"] = nullptr;
  if (train.manifest) {
    for (const HashedPath& output : train.manifest->outputs) {
      if (output.path == "model.safetensors") training["model_bytes"] = output.size_bytes;
    }
  }
  return training;
}

Json Versions(const WorkspaceState& state) {
  Json versions = {{"nrff", Version()}, {"colmap", At(state.Facts("sfm"), "colmap_version")}};
  for (const StageState& stage : state.stages) {
    if (stage.manifest && stage.manifest->version != Version()) versions[stage.name] = stage.manifest->version;
  }
  return versions;
}

}  // namespace

const Json& At(const Json& value, const char* key) {
  static const Json null;
  const auto found = value.is_object() ? value.find(key) : value.end();
  return found == value.end() ? null : *found;
}

const StageState& WorkspaceState::Stage(const std::string& name) const {
  static const StageState absent;
  const auto found = std::find_if(stages.begin(), stages.end(), [&](const StageState& s) { return s.name == name; });
  return found == stages.end() ? absent : *found;
}

const Json& WorkspaceState::Facts(const std::string& stage) const {
  static const Json empty = Json::object();
  const std::optional<Manifest>& manifest = Stage(stage).manifest;
  return manifest ? manifest->facts : empty;
}

WorkspaceState ReadWorkspace(const fs::path& path) {
  fs::path root = fs::absolute(path).lexically_normal();
  if (!root.has_filename()) root = root.parent_path();
  const Workspace workspace(root);
  WorkspaceState state;
  state.root = root;
  for (const std::string& name : StageNames()) {
    if (name == "report" || (name == "sfm" && At(state.Facts("ingest"), "posed") == true)) continue;
    state.stages.push_back(ReadStage(workspace, name));
  }
  const Json& name = At(state.Facts("ingest"), "name");
  state.name = name.is_string() ? name.get<std::string>() : EscapePath(root.filename());
  return state;
}

Json Summarise(const WorkspaceState& state) {
  const Json failure = Failure(state);
  Json stages = Json::array(), decisions = Json::array(), options = Json::object(), host;
  double total_seconds = 0;
  for (const StageState& stage : state.stages) {
    if (!stage.manifest) continue;
    const Manifest& manifest = *stage.manifest;
    stages.push_back({{"name", stage.name},
                      {"seconds", manifest.seconds},
                      {"peak_memory_bytes", manifest.peak_memory_bytes},
                      {"reused", stage.reused}});
    total_seconds += manifest.seconds;
    if (host.is_null() || stage.name == "train") host = manifest.host;
    if (!manifest.params.empty()) options[stage.name] = manifest.params;
    for (const Decision& decision : manifest.decisions) {
      decisions.push_back(decision);
      decisions.back()["stage"] = stage.name;
    }
  }
  const bool complete = stages.size() == state.stages.size();
  return {{"schema_version", kSummarySchemaVersion},
          {"name", state.name},
          {"status", !failure.is_null() ? "failed"
                     : complete         ? "complete"
                                        : "incomplete"},
          {"failure", failure},
          {"metrics", Metrics(state)},
          {"images", Images(state)},
          {"split", Split(state)},
          {"decisions", decisions},
          {"stages", stages},
          {"total_seconds", total_seconds},
          {"training", Training(state.Stage("train"))},
          {"settings", {{"options", options}, {"training", At(state.Facts("train"), "settings")}}},
          {"protocol", At(state.Facts("eval"), "protocol")},
          {"warnings", Warnings(state)},
          {"versions", Versions(state)},
          {"host", host}};
}

}  // namespace nrff
