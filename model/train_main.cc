// nrff-train: a posed scene → a model.

#include "model/training.h"
#include "pipeline/stage.h"

int main(int argc, char** argv) {
  CLI::App app{
      "Trains an NRFF model on a scene's training views.\n"
      "Example: nrff-train --scene work/fox/pose --out work/fox/train --budget-seconds 600"};
  nrff::TrainingRequest request;
  app.add_option("--scene", request.scene_dir, "artifact of nrff-pose normalise")->required()->type_name("DIR");
  app.add_option("--out", request.out, "where the artifact is put")->required()->type_name("DIR");
  app.add_option("--threads", request.n_threads, "threads; 0: one per core")->check(CLI::NonNegativeNumber);

  const char* group = nrff::kParameterGroup;
  app.add_option("--preset", request.preset, "paper, small or tiny (small)")->group(group)->type_name("NAME");
  app.add_option("--set", request.settings, "changes of the preset, as 'field.levels=10 train.depth_weight=0'")
      ->group(group)
      ->type_name("SETTINGS");
  auto* steps = app.add_option("--steps", request.steps, "steps of the optimiser (the preset's)")->group(group);
  steps->check(CLI::Range(int64_t{1}, int64_t{100'000'000}));
  auto* budget = app.add_option("--budget-seconds", request.budget_seconds, "train for so long instead")->group(group);
  budget->check(CLI::Range(1., 1e7))->excludes(steps);
  app.add_option("--seed", request.seed, "of every random number (0)")->group(group);
  nrff::AddForcedOption(app, "--fine-levels", request.fine_levels, "on", "off", "keep all grid levels of the preset");
  nrff::AddForcedOption(app, "--sparse-depth", request.sparse_depth, "on", "off", "learn from depths of sparse points");
  app.add_option("--device", request.device, "where to compute")
      ->group(group)
      ->check(CLI::IsMember({"auto", "cpu", "cuda"}));
  nrff::AddVerbosity(app);
  return nrff::StageMain(app, argc, argv, [&] { nrff::RunTraining(request, nrff::GivenParams(app)); });
}
