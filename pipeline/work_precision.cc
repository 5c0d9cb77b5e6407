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

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr int kWorkPrecisionSchemaVersion = 1;
constexpr char kFolder[] = "work-precision";
constexpr char kRendering[] = "rendering";
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

// What nrff-render measures on the scene's own model.
Json Rendering(const BranchRequest& scene, const WorkPrecisionOptions& options, Verbosity verbosity) {
  const Machine machine = ThisMachine();
  const bool posed = Get<bool>(scene.workspace.Require("ingest").facts, "posed", "ingest's manifest");
  std::vector<Node> nodes = BranchToRunAgain(scene, machine, posed, {});
  std::erase_if(
      nodes, [](const Node& node) { return node.stage == "render" || node.stage == "eval" || node.stage == "report"; });
  Node node;
  node.branch = scene.name;
  node.stage = kRendering;
  node.artifact = scene.workspace.root() / kFolder / kRendering;
  node.log = scene.workspace.Log("work-precision");
  node.cores = machine.cores;
  node.command = {(scene.executables / "nrff-render").string(),
                  "--work-precision",
                  "--scene",
                  scene.workspace.Artifact("pose").string(),
                  "--model",
                  scene.workspace.Artifact("train").string(),
                  "--out",
                  node.artifact.string(),
                  "--verbose"};
  if (!options.threads.empty()) node.command.insert(node.command.end(), {"--threads", options.threads});
  node.params = {{"work-precision", "true"}};
  node.inputs = {scene.name + "/pose", scene.name + "/train"};
  nodes.push_back(node);
  ThrowIfFailed(RunBranches({scene}, std::move(nodes), machine, verbosity));
  return ReadJson(scene.workspace.root() / kFolder / kRendering / "work_precision.json");
}

std::string Figure(const Json& value, const char* format) {
  return value.is_number() ? fmt::format(fmt::runtime(format), value.get<double>()) : "–";
}

std::string BandText(const Json& band, const char* format) {
  if (!band.is_object()) return "–";
  const std::string mean = Figure(band.at("mean"), format);
  if (band.at("least") == band.at("most")) return mean;
  return fmt::format("{} ({} to {})", mean, Figure(band.at("least"), format), Figure(band.at("most"), format));
}

}  // namespace

Json MeasureWorkPrecision(const Workspace& workspace, const WorkPrecisionOptions& options, Verbosity verbosity) {
  const BranchRequest scene = BranchOf(workspace);
  const WorkspaceLock lock(workspace);
  for (const char* stage : {"ingest", "pose", "train"}) workspace.Require(stage);
  const fs::path folder = workspace.root() / kFolder;
  const Json training = Training(scene, options, verbosity);
  const Json measured = Rendering(scene, options, verbosity);
  const Manifest train = workspace.Require("train");
  const Json result = {{"schema_version", kWorkPrecisionSchemaVersion},
                       {"name", scene.name},
                       {"training", training},
                       {"rendering", measured.at("rendering")},
                       {"quadrature", measured.at("quadrature")},
                       {"host", train.host},
                       {"version", Version()},
                       {"date", fmt::format("{:%Y-%m-%d}", fmt::gmtime(std::time(nullptr)))}};
  WriteJson(folder / "work_precision.json", result);
  WriteFileAtomically(folder / "work_precision.md", WorkPrecisionMarkdown(result));
  WriteFileAtomically(folder / "work_precision.html", FillPage("work_precision.html", scene.name, result));
  return result;
}

std::string WorkPrecisionMarkdown(const Json& result) {
  const Json& training = result.at("training");
  std::string text = fmt::format(
      "# Error against run time: {}\n\nnrff {}, {}, {}. Seconds of training are of training alone; figures are means "
      "over all held-out views, renders of 16 bits; in brackets the least and the most of {} seeds.\n\n"
      "| training, s | PSNR, dB | SSIM | LPIPS | steps | density evaluations |\n|---:|---:|---:|---:|---:|---:|\n",
      result.at("name").get<std::string>(), result.at("version").get<std::string>(),
      At(result.at("host"), "cpu").is_string() ? At(result.at("host"), "cpu").get<std::string>() : "unknown processor",
      result.at("date").get<std::string>(), training.at("seeds").get<int>());
  for (const Json& band : training.at("bands")) {
    text += fmt::format("| {} | {} | {} | {} | {} | {} |\n", BandText(band.at("seconds"), "{:.1f}"),
                        BandText(band.at("psnr"), "{:.2f}"), BandText(band.at("ssim"), "{:.4f}"),
                        BandText(band.at("lpips"), "{:.4f}"), BandText(band.at("steps"), "{:.0f}"),
                        BandText(band.at("samples"), "{:.2e}"));
  }
  text += "\nShortest of these trainings that reaches";
  for (const Json& mark : training.at("time_to")) {
    text += fmt::format("{} {:.0f} dB: {}", &mark == &training.at("time_to").front() ? "" : ";",
                        mark.at("psnr").get<double>(),
                        mark.at("seconds").is_number() ? Figure(mark.at("seconds"), "{:.0f} s") : "none");
  }
  const Json& rendering = result.at("rendering");
  text += fmt::format(
      ".\n\n## Rendering\n\n{} held-out views of {} × {} px, {} threads. One setting is varied, nothing else is left "
      "out. The step's error is told from an eighth of the training's step ({} s a view), the others' from the same "
      "step with every sample shaded; PSNR is to the photos. Bold: what nrff-render uses.\n\n"
      "| setting | value | s a view | rms error | largest | samples a ray | shaded | PSNR, dB |\n"
      "|---|---:|---:|---:|---:|---:|---:|---:|\n",
      rendering.at("n_views").get<int>(), rendering.at("width").get<int>(), rendering.at("height").get<int>(),
      rendering.at("threads").get<int>(), Figure(rendering.at("reference_seconds"), "{:.2f}"));
  for (const Json& family : rendering.at("families")) {
    for (const Json& point : family.at("points")) {
      const char* bold = point.at("chosen").get<bool>() ? "**" : "";
      text += fmt::format("| {} | {}{}{} | {} | {} | {} | {} | {} | {} |\n", family.at("family").get<std::string>(),
                          bold, Figure(point.at("value"), "{:.3g}"), bold, Figure(point.at("seconds"), "{:.3f}"),
                          Figure(point.at("rmse"), "{:.2e}"), Figure(point.at("most"), "{:.2e}"),
                          Figure(point.at("samples_per_ray"), "{:.1f}"), Figure(point.at("shaded_per_ray"), "{:.2f}"),
                          Figure(point.at("psnr"), "{:.2f}"));
    }
  }
  text += "\n## Transmittance\n\n|T − closed form| by samples a ray, optical thickness 4, float.\n\n| samples |";
  const Json& quadrature = result.at("quadrature");
  for (const Json& density : quadrature) text += fmt::format(" {} |", density.at("density").get<std::string>());
  text += "\n|---:|";
  for (size_t i = 0; i < quadrature.size(); ++i) text += "---:|";
  for (size_t i = 0; i < quadrature.at(0).at("points").size(); ++i) {
    text += fmt::format("\n| {} |", quadrature.at(0).at("points").at(i).at("n_samples").get<int>());
    for (const Json& density : quadrature)
      text += fmt::format(" {} |", Figure(density.at("points").at(i).at("error"), "{:.1e}"));
  }
  return text + "\n";
}

}  // namespace nrff
