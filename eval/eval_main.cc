// nrff-eval: scores rendered held-out views against the photos, or one folder of images against another.
#include <filesystem>
#include <string>
#include <thread>

#include "eval/evaluate.h"
#include "eval/work_precision.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"
#include "pipeline/manifest.h"
#include "pipeline/stage.h"

namespace {

void MeasureWorkPrecision(const std::filesystem::path& scene, const std::filesystem::path& renders,
                          const std::filesystem::path& out, const nrff::Params& params,
                          const nrff::LpipsChoice& lpips) {
  const nrff::HeldOutPairs pairs(scene, renders);
  nrff::ArtifactWriter artifact("scoring", out, params, pairs.inputs());
  nrff::WriteJson(artifact.dir() / "work_precision.json",
                  {{"scoring", nrff::ScoringWorkPrecision(pairs, lpips.network.get())}});
  artifact.AddDecision(lpips.decision);
  artifact.AddOutput("work_precision.json");
  artifact.Commit();
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app(
      "Scores rendered held-out views against the photos: PSNR, SSIM, LPIPS, error pictures.\n"
      "Example: nrff-eval --scene work/fox/pose --renders work/fox/render --out work/fox/eval\n"
      "Or any two folders of images with the same names, whoever made them:\n"
      "         nrff-eval --truth photos --rendered renders --out scores",
      "nrff-eval");
  std::filesystem::path scene, renders, out;
  nrff::Folders folders;
  int n_threads = int(std::max(1u, std::thread::hardware_concurrency()));
  auto* scene_option = app.add_option("--scene", scene, "Artifact of the pose stage");
  auto* renders_option = app.add_option("--renders", renders, "Artifact of the render stage")->needs(scene_option);
  scene_option->needs(renders_option);
  auto* truth = app.add_option("--truth", folders.truth, "Folder of photos instead")->excludes(scene_option);
  auto* rendered = app.add_option("--rendered", folders.rendered, "Folder of rendered images")->needs(truth);
  truth->needs(rendered);
  app.add_option("--out", out, "Where the artifact is written")->required();
  app.add_option("--masks", folders.masks, "Folder of masks: what is white in them counts")
      ->needs(truth)
      ->group(nrff::kParameterGroup);
  std::string background = "white";
  app.add_option("--background", background, "Behind alpha and outside masks: white, black (white)")
      ->needs(truth)
      ->check(CLI::IsMember({"white", "black"}))
      ->group(nrff::kParameterGroup);
  bool work_precision = false;
  app.add_flag("--work-precision", work_precision, "Figures and seconds at several image sizes, instead of scores")
      ->needs(scene_option)
      ->group(nrff::kParameterGroup);
  std::string lpips = nrff::needs::kNoLpips;
  app.add_option("--lpips", lpips, "LPIPS network (eval/export_lpips.py), or none")
      ->type_name("FILE")
      ->default_str("~/.local/share/nrff/lpips_vgg.onnx where it is there");
  app.add_option("--threads", n_threads, "Images at a time")->capture_default_str()->check(CLI::Range(1, 1024));
  nrff::AddVerbosity(app);
  return nrff::StageMain(app, argc, argv, [&] {
    const bool given_folders = truth->count() > 0;
    if (!given_folders && scene_option->count() == 0) {
      throw nrff::UsageError("give --scene and --renders, or --truth and --rendered (see nrff-eval --help)");
    }
    const std::filesystem::path found = nrff::DefaultLpipsNetwork();
    if (app.count("--lpips") == 0 && !found.empty()) lpips = found.string();
    nrff::Params params = nrff::GivenParams(app);
    params["lpips"] = nrff::LpipsParameter(lpips);
    const nrff::LpipsChoice choice = nrff::ChooseLpips(lpips);
    if (given_folders) {
      if (params.contains("masks")) params["masks"] = nrff::EscapePath(folders.masks);
      folders.background = background == "white" ? nrff::Background::kWhite : nrff::Background::kBlack;
      nrff::Compare(folders, out, params, choice, n_threads);
    } else if (work_precision) {
      MeasureWorkPrecision(scene, renders, out, params, choice);
    } else {
      nrff::Evaluate(scene, renders, out, params, choice, n_threads);
    }
  });
}
