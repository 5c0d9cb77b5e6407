// nrff-train: a posed scene → a model.

#include <cstdio>
#include <iterator>
#include <string>
#include <vector>

#include "model/config.h"
#include "model/training.h"
#include "pipeline/manifest.h"
#include "pipeline/stage.h"

int main(int argc, char** argv) {
  CLI::App app(
      "Trains an NRFF model on a scene's training views.\n"
      "Example: nrff-train --scene work/fox/pose --out work/fox/train --budget 10m\n"
      "All settings of a preset: nrff-train --probe --preset small",
      "nrff-train");
  app.set_version_flag("--version", nrff::Version());
  nrff::TrainingRequest request;
  bool probe = false;
  auto* scene = app.add_option("--scene", request.scene_dir, "artifact of nrff-pose normalise")->type_name("DIR");
  auto* what = app.add_option_group("what to do");
  what->require_option(1);
  what->add_option("--out", request.out, "where the artifact is put")->type_name("DIR")->needs(scene);
  what->add_flag("--probe", probe, "check the options, print what they mean as one JSON object, train nothing");
  app.add_option("--base", request.base, "artifact of a training on fewer of the views, to go on from")
      ->type_name("DIR");
  app.add_flag("--check", request.check, "end at the first number that is not finite and name it");
  app.add_option("--threads", request.n_threads, "threads; 0: one per core")->check(CLI::NonNegativeNumber);

  const char* group = nrff::kParameterGroup;
  app.add_option("--preset", request.preset, "paper, small or tiny (small, or tiny under a budget too short for it)")
      ->group(group)
      ->type_name("NAME");
  app.add_option("--set", request.settings, "changes of the preset (see --probe), as 'field.levels=10 train.rays=2048'")
      ->group(group)
      ->type_name("SETTINGS");
  app.add_option("--directional", request.directional, "encoding of directions (ree)")
      ->group(group)
      ->type_name("NAME")
      ->check(CLI::IsMember(
          std::vector<std::string>(std::begin(nrff::kDirectionalEncodings), std::end(nrff::kDirectionalEncodings))));
  auto* steps = app.add_option("--steps", request.steps, "steps of the optimiser (the preset's)")->group(group);
  steps->check(CLI::Range(int64_t{1}, int64_t{100'000'000}));
  const auto set_budget = [&](const std::string& text) {
    request.budget_seconds = nrff::ParseDuration(text, "--budget");
  };
  app.add_option_function<std::string>("--budget", set_budget, "train for so long instead: 90s, 10m, 1h")
      ->group(group)
      ->type_name("TIME")
      ->excludes(steps);
  app.add_option("--seed", request.seed, "of every random number (0)")->group(group);
  nrff::AddForcedOption(app, "--fine-levels", request.fine_levels, "on", "off", "keep all grid levels of the preset");
  nrff::AddForcedOption(app, "--sparse-depth", request.sparse_depth, "on", "off", "learn from depths of sparse points");
  nrff::AddForcedOption(app, "--exposure-correction", request.exposure_correction, "on", "off",
                        "give training views colours of their own");
  nrff::AddForcedOption(app, "--camera-correction", request.camera_correction, "on", "off",
                        "correct cameras where photos and model disagree");
  app.add_option("--device", request.device, "where to compute")
      ->group(group)
      ->check(CLI::IsMember({"auto", "cpu", "cuda"}));
  nrff::AddVerbosity(app);
  return nrff::StageMain(app, argc, argv, [&] {
    if (probe) {
      std::printf("%s\n", nrff::DescribeTraining(request).dump(1).c_str());
    } else {
      nrff::RunTraining(request, nrff::GivenParams(app));
    }
  });
}
