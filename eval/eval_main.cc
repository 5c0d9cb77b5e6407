// nrff-eval: scores rendered held-out views against the photos.
#include <thread>

#include "eval/evaluate.h"
#include "pipeline/stage.h"

int main(int argc, char** argv) {
  CLI::App app(
      "Scores rendered held-out views against the photos: PSNR, SSIM, LPIPS, error pictures.\n"
      "Example: nrff-eval --scene work/fox/pose --renders work/fox/render --out work/fox/eval",
      "nrff-eval");
  std::filesystem::path scene, renders, out;
  int n_threads = int(std::max(1u, std::thread::hardware_concurrency()));
  app.add_option("--scene", scene, "Artifact of the pose stage")->required();
  app.add_option("--renders", renders, "Artifact of the render stage")->required();
  app.add_option("--out", out, "Where the artifact is written")->required();
  std::string lpips = nrff::needs::kNoLpips;
  app.add_option("--lpips", lpips, "LPIPS network (eval/export_lpips.py), or none")
      ->type_name("FILE")
      ->default_str("~/.local/share/nrff/lpips_vgg.onnx where it is there");
  app.add_option("--threads", n_threads, "Images at a time")->capture_default_str()->check(CLI::Range(1, 1024));
  nrff::AddVerbosity(app);
  return nrff::StageMain(app, argc, argv, [&] {
    const std::filesystem::path found = nrff::DefaultLpipsNetwork();
    if (app.count("--lpips") == 0 && !found.empty()) lpips = found.string();
    nrff::Params params = nrff::GivenParams(app);
    params["lpips"] = nrff::LpipsParameter(lpips);
    nrff::Evaluate(scene, renders, out, params, nrff::ChooseLpips(lpips), n_threads);
  });
}
