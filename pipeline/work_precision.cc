#include "pipeline/work_precision.h"

#include <fmt/chrono.h>
#include <fmt/format.h>

#include <algorithm>
#include <ctime>
#include <set>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/manifest.h"
#include "pipeline/report_page.h"
#include "pipeline/report_summary.h"
#include "pipeline/run.h"
#include "pipeline/stage.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr int kWorkPrecisionSchemaVersion = 1;
constexpr char kFolder[] = "work-precision";
constexpr double kPsnrMarks[] = {20, 22, 25, 27, 30, 33, 35};  // dB

struct TrainingRun {
  double budget_seconds;
  int seed;
  BranchRequest request;
};

// A workspace for one budget and seed, with the poses of the scene's own.
TrainingRun MakeTrainingRun(const BranchRequest& scene, double budget, int seed, const std::string& threads) {
  const std::string name = fmt::format("{}s-seed{}", budget, seed);
  BranchRequest request = scene;
  request.name = name;
  request.workspace = Workspace(scene.workspace.root() / kFolder / name);
  request.threads = threads;
  request.options.erase("steps");
  request.options["budget"] = fmt::format("{}s", budget);
  request.options["seed"] = std::to_string(seed);
  request.options["bit-depth"] = "16";
  request.workspace.Claim(request.capture);
  for (const char* shared : {"ingest", "sfm", "pose"}) {
    const fs::path link = request.workspace.Artifact(shared);
    std::error_code error;
    if (fs::exists(scene.workspace.Artifact(shared), error) && !fs::exists(fs::symlink_status(link, error))) {
      fs::create_symlink(fs::path("../..") / shared, link);
    }
  }
  return {budget, seed, std::move(request)};
}

Json RunRow(const fs::path& folder, const TrainingRun& run) {
  const WorkspaceState state = ReadWorkspace(run.request.workspace.root());
  const Json &train = state.Facts("train"), &eval = state.Facts("eval");
  return {{"budget_seconds", run.budget_seconds},
          {"seed", run.seed},
          {"workspace", EscapePath(fs::proximate(state.root, fs::absolute(folder)))},
          {"seconds", At(train, "seconds_training")},
          {"seconds_evaluating", At(train, "seconds_evaluating")},
          {"steps", At(train, "steps")},
          {"samples", At(train, "samples")},
          {"preset", At(train, "preset")},
          {"psnr", At(eval, "psnr")},
          {"ssim", At(eval, "ssim")},
          {"lpips", At(eval, "lpips")}};
}

// {mean, least, most} of a figure of the rows; null where some row has none.
Json Band(const std::vector<Json>& rows, const char* key) {
  double sum = 0, least = HUGE_VAL, most = -HUGE_VAL;
  for (const Json& row : rows) {
    if (!row.at(key).is_number()) return nullptr;
    const double value = row.at(key).get<double>();
    sum += value;
    least = std::min(least, value);
    most = std::max(most, value);
  }
  return rows.empty() ? Json() : Json({{"mean", sum / double(rows.size())}, {"least", least}, {"most", most}});
}

Json Bands(const Json& runs, const std::vector<double>& budgets) {
  Json bands = Json::array();
  for (const double budget : budgets) {
    std::vector<Json> rows;
    for (const Json& run : runs) {
      if (run.at("budget_seconds") == budget) rows.push_back(run);
    }
    Json band = {{"budget_seconds", budget}};
    for (const char* key : {"seconds", "samples", "steps", "psnr", "ssim", "lpips"}) band[key] = Band(rows, key);
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
  std::vector<TrainingRun> runs;
  std::vector<BranchRequest> requests;
  for (const double budget : options.budgets) {
    for (int seed = 0; seed < options.n_seeds; ++seed) {
      runs.push_back(MakeTrainingRun(scene, budget, seed, options.threads));
      requests.push_back(runs.back().request);
    }
  }
  ThrowIfFailed(RunRequests(requests, verbosity));
  Json rows = Json::array();
  for (const TrainingRun& run : runs) rows.push_back(RunRow(scene.workspace.root() / kFolder, run));
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
  std::vector<std::pair<const char*, const char*>> reads;  // option, stage
  bool takes_threads;
};

Json Measured(const Measurement& measurement, const BranchRequest& scene, const WorkPrecisionOptions& options,
              Verbosity verbosity) {
  const Machine machine = ThisMachine();
  const bool posed = Get<bool>(scene.workspace.Require("ingest").facts, "posed", "ingest's manifest");
  std::vector<Node> nodes = BranchToRunAgain(scene, machine, posed, {});
  std::erase_if(nodes, [](const Node& node) { return node.stage == "eval" || node.stage == "report"; });
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
  if (measurement.takes_threads && !options.threads.empty()) {
    node.command.insert(node.command.end(), {"--threads", options.threads});
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

const Measurement kRendering{"rendering", "nrff-render", {{"--scene", "pose"}, {"--model", "train"}}, true};
const Measurement kScoring{"scoring", "nrff-eval", {{"--scene", "pose"}, {"--renders", "render"}}, false};

// What SfM spends its time on: one is varied, the others are as `nrff run` begins with many photos.
struct PoseSetting {
  int image_size = 1000, features = 2048;
  const char* matching = "sequential";
};
constexpr PoseSetting kPoseSettings[] = {{},
                                         {.image_size = 500},
                                         {.image_size = 1600},
                                         {.features = 512},
                                         {.features = 1024},
                                         {.features = 4096},
                                         {.matching = "exhaustive"}};

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

Json PosePoint(const PoseSetting& setting, const BranchResult& result, const BranchRequest& scene) {
  const PoseSetting chosen;
  Json point = {{"image_size", setting.image_size},
                {"features", setting.features},
                {"matching", setting.matching},
                {"chosen", setting.image_size == chosen.image_size && setting.features == chosen.features &&
                               std::string(setting.matching) == chosen.matching},
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
    point["errors"] =
        JsonFrom(executor, {(scene.executables / "nrff-pose").string(), "compare", "--json", "--quiet", "--estimated",
                            result.request.workspace.root().string(), "--truth", scene.workspace.root().string()});
  }
  return point;
}

Json Poses(const BranchRequest& scene, const WorkPrecisionOptions& options, Verbosity verbosity) {
  const auto nothing = [](const char* reason) { return Json{{"reason", reason}, {"points", Json::array()}}; };
  if (!Get<bool>(scene.workspace.Require("ingest").facts, "posed", "ingest's manifest")) {
    return nothing("the capture brings no poses that estimated ones could be compared with");
  }
  const fs::path photos = PhotoFolder(scene.workspace);
  if (photos.empty()) return nothing("the photos do not lie in one folder of their own");
  std::vector<BranchRequest> requests;
  requests.reserve(std::size(kPoseSettings));
  for (const PoseSetting& setting : kPoseSettings) {
    BranchRequest request = scene;
    request.name = fmt::format("{}px-{}-{}", setting.image_size, setting.features, setting.matching);
    request.workspace = Workspace(scene.workspace.root() / kFolder / "poses" / request.name);
    request.capture = photos;
    request.threads = options.threads;
    request.until = "pose";
    request.options = {{"sfm-image-size", std::to_string(setting.image_size)},
                       {"sfm-features", std::to_string(setting.features)},
                       {"matching", setting.matching}};
    requests.push_back(std::move(request));
  }
  const std::vector<BranchResult> results = RunRequests(requests, verbosity);
  Json points = Json::array();
  for (size_t i = 0; i < results.size(); ++i) points.push_back(PosePoint(kPoseSettings[i], results[i], scene));
  return {{"reason", nullptr}, {"points", points}};
}

}  // namespace

Json MeasureWorkPrecision(const Workspace& workspace, const WorkPrecisionOptions& options, Verbosity verbosity) {
  const BranchRequest scene = BranchOf(workspace);
  const WorkspaceLock lock(workspace);
  for (const char* stage : {"ingest", "pose", "train"}) workspace.Require(stage);
  const fs::path folder = workspace.root() / kFolder;
  const auto asked = [&](const char* part) {
    return std::find(options.parts.begin(), options.parts.end(), part) != options.parts.end();
  };
  const Json training = asked("training") ? Training(scene, options, verbosity) : Json();
  const Json measured = asked("rendering") ? Measured(kRendering, scene, options, verbosity) : Json();
  const Json scoring = asked("scoring") ? Measured(kScoring, scene, options, verbosity) : Json();
  const Json poses = asked("poses") ? Poses(scene, options, verbosity) : Json();
  const Manifest train = workspace.Require("train");
  const std::string name = ReadWorkspace(workspace.root()).name;
  const Json result = {{"schema_version", kWorkPrecisionSchemaVersion},
                       {"name", name},
                       {"training", training},
                       {"rendering", At(measured, "rendering")},
                       {"quadrature", At(measured, "quadrature")},
                       {"scoring", At(scoring, "scoring")},
                       {"poses", poses},
                       {"host", train.host},
                       {"version", Version()},
                       {"date", fmt::format("{:%Y-%m-%d}", fmt::gmtime(std::time(nullptr)))}};
  WriteJson(folder / "work_precision.json", result);
  WriteFileAtomically(folder / "work_precision.md", WorkPrecisionMarkdown(result));
  WriteFileAtomically(folder / "work_precision.html", FillPage("work_precision.html", name, result));
  return result;
}

}  // namespace nrff
