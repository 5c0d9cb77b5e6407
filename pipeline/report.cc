#include "pipeline/report.h"

#include <string>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"
#include "pipeline/manifest.h"
#include "pipeline/report_content.h"
#include "pipeline/report_page.h"
#include "pipeline/report_summary.h"
#include "pipeline/stability.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr int kJointSummarySchemaVersion = 1;

// What the page says in detail about every stage, by name.
Json Facts(const WorkspaceState& state) {
  Json facts = Json::object();
  for (const StageState& stage : state.stages) facts[stage.name] = state.Facts(stage.name);
  return facts;
}

// A part of the page that damaged files leave out: null, with the reason among the summary's warnings.
template <typename Make>
Json PartOrWarning(Json& summary, const Make& make) {
  try {
    return make();
  } catch (const Error& error) {
    summary["warnings"].push_back({{"kind", "damaged files"}, {"text", error.what()}, {"items", Json::array()}});
    return nullptr;
  }
}

// One capture as a row of the joint report.
Json Row(const fs::path& folder, const WorkspaceState& state, const Json& summary) {
  const std::string place = EscapePath(fs::proximate(state.root, folder));
  return {{"workspace", place},
          {"report", fs::exists(state.root / "report" / "report.html") ? Json(place + "/report/report.html") : Json()},
          {"name", summary["name"]},
          {"status", summary["status"]},
          {"failure", summary["failure"]},
          {"metrics", summary["metrics"]},
          {"split", summary["split"]},
          {"training_seconds", summary["training"]["seconds"]},
          {"total_seconds", summary["total_seconds"]},
          {"model_bytes", summary["training"]["model_bytes"]},
          {"device", summary["training"]["device"]}};
}

}  // namespace

void WriteReport(const fs::path& workspace) {
  const WorkspaceState state = ReadWorkspace(workspace);
  std::vector<HashedPath> inputs;
  for (const StageState& stage : state.stages) {
    if (stage.manifest) inputs.push_back(ArtifactInput(state.root / stage.name, *stage.manifest));
  }
  ArtifactWriter artifact("report", state.root / "report", {}, inputs);
  Json summary = Summarise(state);
  const Json pictures = PartOrWarning(summary, [&] { return Pictures(state, summary["images"]); });
  const Json geometry = PartOrWarning(summary, [&] { return Geometry(state); });
  const Json certificate = PartOrWarning(summary, [&] { return Certificate(state); });
  const Json videos = PartOrWarning(summary, [&] { return VideoFrames(state); });
  const Json stability = PartOrWarning(summary, [&] { return ReadStability(state.root / kStabilityFolder); });
  WriteJson(artifact.dir() / "summary.json", summary);
  const Json page = {{"summary", summary},    {"facts", Facts(state)},      {"pictures", pictures},
                     {"geometry", geometry},  {"certificate", certificate}, {"videos", videos},
                     {"stability", stability}};
  WriteFileAtomically(artifact.dir() / "report.html", FillPage("report.html", state.name, page));
  artifact.AddOutput("summary.json");
  artifact.AddOutput("report.html");
  artifact.facts() = {{"status", summary["status"]}, {"failure", summary["failure"]}};
  artifact.Commit();
}

void WriteJointReport(const fs::path& folder, const std::vector<fs::path>& workspaces) {
  const fs::path root = fs::absolute(folder);
  Json captures = Json::array(), shown = Json::array();
  std::vector<Run> runs;
  for (const fs::path& workspace : workspaces) {
    const WorkspaceState state = ReadWorkspace(workspace);
    runs.push_back({state, Summarise(state)});
    Json& summary = runs.back().summary;
    captures.push_back(Row(root, state, summary));
    shown.push_back(captures.back());
    shown.back()["picture"] = PartOrWarning(summary, [&] { return MedianPicture(state, summary["images"]); });
    shown.back()["curve"] = summary["training"]["curve"];
  }
  Json damage = {{"warnings", Json::array()}};  // as in a row: what cannot be read is not shown
  const Json comparisons = PartOrWarning(damage, [&] { return Comparisons(runs); });
  const fs::path out = root / "report";
  std::error_code error;
  fs::create_directories(out, error);
  if (error) throw ResourceError("Folder " + EscapePath(out) + " cannot be made (" + error.message() + ").");
  WriteJson(out / "summary.json", {{"schema_version", kJointSummarySchemaVersion}, {"captures", captures}});
  WriteFileAtomically(out / "report.html", FillPage("joint.html", std::to_string(workspaces.size()) + " runs",
                                                    {{"captures", shown}, {"comparisons", comparisons}}));
}

}  // namespace nrff
