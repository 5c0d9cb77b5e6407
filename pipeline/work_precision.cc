#include "pipeline/work_precision.h"

#include <fmt/chrono.h>
#include <fmt/format.h>

#include <algorithm>
#include <ctime>
#include <set>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/manifest.h"
#include "pipeline/needs.h"
#include "pipeline/report_page.h"
#include "pipeline/report_summary.h"
#include "pipeline/run.h"
#include "pipeline/stage.h"
#include "pipeline/trainings.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr int kWorkPrecisionSchemaVersion = 1;
constexpr char kFolder[] = "work-precision";
constexpr double kPsnrMarks[] = {20, 22, 25, 27, 30, 33, 35};  // dB

Json Bands(const Json& runs, const std::vector<double>& budgets) {
  Json bands = Json::array();
  for (const double budget : budgets) {
    std::vector<Json> rows;
    for (const Json& run : runs) {
      if (run.at("budget_seconds") == budget) rows.push_back(run);
    }
    Json band = {{"budget_seconds", budget}};
    for (const char* key : {"seconds", "samples", "steps", "psnr", "ssim", "lpips"}) band[key] = Band(rows, key);
    for (const Json& row : rows) {
      if (!row.at("preset").is_string()) continue;
      Json& n_runs = band["presets"][row.at("preset").get<std::string>()];
      n_runs = n_runs.is_number() ? n_runs.get<int>() + 1 : 1;
    }
    bands.push_back(band);
  }
  return bands;
}

Json TimeTo(const Json& bands) {
  Json marks = Json::array();
  for (const double psnr : kPsnrMarks) {
    Json seconds;
    for (const Json& band : bands) {
      if (seconds.is_null() && band.at("psnr").is_object() && band.at("psnr").at("mean") >= psnr) {
        seconds = band.at("seconds").at("mean");
      }
    }
    marks.push_back({{"psnr", psnr}, {"seconds", seconds}});
  }
  return marks;
}

Json Training(const BranchRequest& scene, const WorkPrecisionOptions& options, Verbosity verbosity) {
  const fs::path folder = scene.workspace.root() / kFolder;
  std::vector<BranchRequest> requests;
  std::vector<double> budgets;  // of each
  for (const double budget : options.budgets) {
    for (int seed = 0; seed < options.n_seeds; ++seed) {
      BranchRequest request = TrainingBeside(scene, folder / fmt::format("{}s-seed{}", budget, seed));
      request.options["budget"] = fmt::format("{}s", budget);
      request.options["seed"] = std::to_string(seed);
      requests.push_back(std::move(request));
      budgets.push_back(budget);
    }
  }
  RunTrainings(scene, requests, verbosity);
  Json rows = Json::array();
  for (size_t i = 0; i < requests.size(); ++i) {
    Json row = TrainingRow(folder, requests[i]);
    row["budget_seconds"] = budgets[i];
    rows.push_back(row);
  }
  const Json bands = Bands(rows, options.budgets);
  return {{"budgets", options.budgets},
          {"seeds", options.n_seeds},
          {"runs", rows},
          {"bands", bands},
          {"time_to", TimeTo(bands)}};
}

// What a stage's program measures on what the scene's workspace holds, as a node beside the scene's own.
struct Measurement {
  const char* name;                                        // of the artifact
  const char* program;                                     // which takes --work-precision
  std::vector<std::pair<std::string, std::string>> reads;  // option, stage; in the order of the pipeline
};

Json Measured(const Measurement& measurement, const BranchRequest& scene, Verbosity verbosity) {
  const Machine machine = ThisMachine();
  const bool posed = Get<bool>(scene.workspace.Require("ingest").facts, "posed", "ingest's manifest");
  std::vector<Node> nodes = BranchToRunAgain(scene, machine, posed, {});
  const std::string& last = measurement.reads.back().second;
  const auto end = std::find_if(nodes.begin(), nodes.end(), [&](const Node& node) { return node.stage == last; });
  nodes.erase(end + 1, nodes.end());
  Node node;
  node.branch = scene.name;
  node.stage = measurement.name;
  node.artifact = scene.workspace.root() / kFolder / measurement.name;
  node.log = scene.workspace.Log(std::string("work-precision-") + measurement.name);
  node.cores = machine.cores;
  node.params = {{"work-precision", "true"}};
  node.command = {(scene.executables / measurement.program).string(), "--work-precision", "--out",
                  node.artifact.string(), "--verbose"};
  for (const auto& [option, stage] : measurement.reads) {
    scene.workspace.Require(stage);
    node.command.insert(node.command.end(), {option, scene.workspace.Artifact(stage).string()});
    node.inputs.push_back(scene.name + "/" + stage);
  }
  if (std::string(measurement.program) == "nrff-eval") {
    const std::string network = LpipsNetworkOf(scene);
    node.command.insert(node.command.end(), {"--lpips", network});
    node.params["lpips"] = LpipsParameter(network);
  }
  nodes.push_back(node);
  ThrowIfFailed(RunBranches({scene}, std::move(nodes), machine, verbosity));
  return ReadJson(node.artifact / "work_precision.json");
}

const Measurement kRendering{"rendering", "nrff-render", {{"--scene", "pose"}, {"--model", "train"}}};
const Measurement kScoring{"scoring", "nrff-eval", {{"--scene", "pose"}, {"--renders", "render"}}};

// What SfM spends its time on: one is varied, the others are as `nrff run` begins with so many photos.
struct PoseSetting {
  int image_size = 1000, features = 2048;
  bool exhaustive = false;

  const char* matching() const { return exhaustive ? "exhaustive" : "selective"; }
  bool operator==(const PoseSetting&) const = default;
};

// The first is that of `nrff run`.
std::vector<PoseSetting> PoseSettings(const Json& ingest) {
  const std::string where = "ingest's manifest";
  const bool ordered = Get<bool>(ingest, "ordered", where);
  const PoseSetting usual{.exhaustive = needs::ExhaustiveMatching(Get<int>(ingest, "n_images", where), ordered).needed};
  std::vector<PoseSetting> settings(7, usual);
  settings[1].image_size = 500;
  settings[2].image_size = 1600;
  settings[3].features = 512;
  settings[4].features = 1024;
  settings[5].features = 4096;
  settings[6].exhaustive = !usual.exhaustive;
  return settings;
}

// The folder that all photos of the capture lie in; empty where they lie in several.
fs::path PhotoFolder(const Workspace& workspace) {
  const fs::path file = workspace.Artifact("ingest") / "capture.json";
  const std::string where = EscapePath(file);
  const Json capture = ReadJson(file);
  const fs::path root = UnescapePath(Get<std::string>(capture, "root", where));
  std::set<fs::path> folders;
  for (const Json& image : Get<Json>(capture, "images", where)) {
    folders.insert((root / UnescapePath(Get<std::string>(image, "path", where))).parent_path());
  }
  return folders.size() == 1 && *folders.begin() != root ? *folders.begin() : fs::path();
}

Json PosePoint(const PoseSetting& setting, bool chosen, const BranchResult& result, const BranchRequest& scene) {
  Json point = {{"image_size", setting.image_size},
                {"features", setting.features},
                {"matching", setting.matching()},
                {"chosen", chosen},
                {"errors", nullptr},
                {"error", nullptr}};
  const BranchResult::Stage* failed = result.FirstFailed();
  if (failed != nullptr) point["error"] = failed->outcome.job.error;
  const BranchResult::Stage* sfm = result.Find("sfm");
  const Json facts = sfm != nullptr && sfm->manifest ? sfm->manifest->facts : Json::object();
  double seconds = 0;
  for (const char* part : {"seconds_features", "seconds_matching", "seconds_mapping"}) {
    if (At(facts, part).is_number()) seconds += facts.at(part).get<double>();
  }
  point["seconds"] = seconds > 0 ? Json(seconds) : Json();
  point["n_registered"] = At(facts, "n_registered");
  point["n_images"] = At(facts, "n_images");
  if (failed == nullptr) {
    LocalExecutor executor;
    try {
      point["errors"] =
          JsonFrom(executor, {(scene.executables / "nrff-pose").string(), "compare", "--json", "--quiet", "--estimated",
                              result.request.workspace.root().string(), "--truth", scene.workspace.root().string()});
    } catch (const Error& error) {
      if (executor.StopSignal() != 0) throw;
      point["error"] = error.what();
    }
  }
  return point;
}

Json Poses(const BranchRequest& scene, Verbosity verbosity) {
  const auto nothing = [](const char* reason) { return Json{{"reason", reason}, {"points", Json::array()}}; };
  if (!Get<bool>(scene.workspace.Require("ingest").facts, "posed", "ingest's manifest")) {
    return nothing("the capture brings no poses that estimated ones could be compared with");
  }
  const fs::path photos = PhotoFolder(scene.workspace);
  if (photos.empty()) return nothing("the photos do not lie in one folder of their own");
  std::vector<BranchRequest> requests;
  const std::vector<PoseSetting> settings = PoseSettings(scene.workspace.Require("ingest").facts);
  requests.reserve(settings.size());
  for (const PoseSetting& setting : settings) {
    BranchRequest request = scene;
    request.name = fmt::format("{}px-{}-{}", setting.image_size, setting.features, setting.matching());
    request.workspace = Workspace(scene.workspace.root() / kFolder / "poses" / request.name);
    request.capture = photos;
    request.until = "pose";
    request.options = {{"sfm-image-size", std::to_string(setting.image_size)},
                       {"sfm-features", std::to_string(setting.features)},
                       {"matching", setting.matching()}};
    requests.push_back(std::move(request));
  }
  const std::vector<BranchResult> results = RunRequests(requests, verbosity);
  Json points = Json::array();
  for (size_t i = 0; i < results.size(); ++i) {
    points.push_back(PosePoint(settings[i], settings[i] == settings.front(), results[i], scene));
  }
  return {{"reason", nullptr}, {"points", points}};
}

}  // namespace

Json MeasureWorkPrecision(const Workspace& workspace, const WorkPrecisionOptions& options, Verbosity verbosity) {
  const BranchRequest scene = BranchOf(workspace);
  const WorkspaceLock lock(workspace);
  const auto asked = [&](const char* part) {
    return std::find(options.parts.begin(), options.parts.end(), part) != options.parts.end();
  };
  // What is missing is told before hours of training.
  for (const char* stage : {"ingest", "pose"}) workspace.Require(stage);
  if (asked("rendering")) workspace.Require("train");
  if (asked("scoring")) workspace.Require("render");

  const fs::path folder = workspace.root() / kFolder;
  const std::string name = ReadWorkspace(workspace.root()).name;
  Json result = {{"schema_version", kWorkPrecisionSchemaVersion},
                 {"name", name},
                 {"parts", options.parts},
                 {"host", workspace.Require("pose").host},
                 {"version", Version()},
                 {"date", fmt::format("{:%Y-%m-%d}", fmt::gmtime(std::time(nullptr)))}};
  for (const char* part : {"training", "rendering", "quadrature", "scoring", "poses"}) result[part] = nullptr;
  // After every part, so that one that fails or is stopped does not take the others' results along.
  const auto write = [&] {
    fs::create_directories(folder);
    WriteJson(folder / "work_precision.json", result);
    WriteFileAtomically(folder / "work_precision.md", WorkPrecisionMarkdown(result));
    WriteFileAtomically(folder / "work_precision.html", FillPage("work_precision.html", name, result));
  };
  if (asked("training")) {
    result["training"] = Training(scene, options, verbosity);
    write();
  }
  if (asked("rendering")) {
    const Json measured = Measured(kRendering, scene, verbosity);
    for (const char* part : {"rendering", "quadrature"}) result[part] = measured.at(part);
    write();
  }
  if (asked("scoring")) {
    result["scoring"] = Measured(kScoring, scene, verbosity).at("scoring");
    write();
  }
  if (asked("poses")) {
    result["poses"] = Poses(scene, verbosity);
    write();
  }
  return result;
}

}  // namespace nrff
