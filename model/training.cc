#include "model/training.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <functional>
#include <optional>

#include "model/checkpoint.h"
#include "model/config.h"
#include "model/cuda/gpu_library.h"
#include "model/held_out.h"
#include "model/schedule.h"
#include "model/trainer.h"
#include "pipeline/error.h"
#include "pipeline/extension.h"
#include "pipeline/files.h"
#include "pipeline/log.h"
#include "pipeline/progress.h"
#include "pipeline/scene.h"
#include "pipeline/statistics.h"
#include "render/compute.h"

namespace nrff {
namespace {

using Clock = std::chrono::steady_clock;

constexpr double kSecondsPerCheckpoint = 10;  // of training

double SecondsSince(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

std::string Decibels(double psnr) {
  char text[32];
  std::snprintf(text, sizeof(text), "%.2f dB", psnr);
  return text;
}

// The preset chosen by what was measured, in the partial artifact: a training that goes on does not measure again.
constexpr char kChoiceFile[] = "preset.json";

constexpr double kMeasuredSeconds = 2;      // of the budget, at most
constexpr double kMeasuredFraction = 0.05;  // of the budget, at most

constexpr int64_t kSlowSteps = 32;  // two intervals of the occupancy grid

bool ChoosesBySpeed(const TrainingRequest& request) {
  return request.preset == kAutoPreset && request.budget_seconds > 0;
}

// The preset asked for, or the one that is tried first.
std::string FirstPreset(const std::string& asked) { return asked == kAutoPreset ? "small" : asked; }

void ApplyRequest(const TrainingRequest& request, Preset& preset) {
  ApplySettings(request.settings, preset);
  if (!request.directional.empty()) {
    if (request.settings.find("field.directional_encoding=") != std::string::npos) {
      throw UsageError("--directional and --set both name the directional encoding; give it once");
    }
    ApplySettings("field.directional_encoding=\"" + request.directional + "\"", preset);
  }
  if (request.steps > 0) preset.train.steps = request.steps;
}

Preset ChoosePreset(const TrainingRequest& request, const std::string& name, const Scene& scene, size_t n_depths,
                    std::vector<Decision>& decisions) {
  Preset preset = MakePreset(name, scene.unbounded);
  ApplyRequest(request, preset);
  const int n_views = int(scene.ViewsOf(Split::kTrain).size());
  decisions.push_back(FitCorrections(preset, name, scene, request.exposure_correction));
  decisions.push_back(FitDepths(preset, n_depths, scene.unbounded, request.sparse_depth));
  FitCameras(preset, request.camera_correction);
  decisions.push_back(FitLevelsToViews(preset, name, n_views, request.fine_levels));
  return preset;
}

// What of Settings is the scene's.
constexpr const char *kFrameKey = "frame", *kViewsKey = "views";

// All that decides what training computes, beside the pixels.
Json Settings(const TrainingRequest& request, const std::string& name, const Preset& preset, const Scene& scene) {
  Json views = Json::array();
  for (const int i : scene.ViewsOf(Split::kTrain)) views.push_back(scene.views[size_t(i)].id);
  return {{"preset", name},
          {"field", ToJson(preset.field)},
          {"train", ToJson(preset.train)},
          {"budget_seconds", request.budget_seconds},
          {"seed", request.seed},
          {kFrameKey,
           {{"scene_from_world", scene.scene_from_world},
            {"unbounded", scene.unbounded},
            {"aabb_min", scene.aabb_min},
            {"aabb_max", scene.aabb_max}}},
          {kViewsKey, std::move(views)}};
}

// A training on fewer of the views.
struct Base {
  BaseTraining training;
  Json settings;
  std::vector<std::string> views;  // ids
};

std::optional<Base> ReadBase(const std::filesystem::path& dir) {
  if (dir.empty()) return {};
  Base base{ReadBaseTraining(dir), {}, {}};
  const std::string where = EscapePath(dir / kCheckpointFile);
  try {
    base.settings = ParseJson(base.training.settings);
  } catch (const JsonSyntaxError& error) {
    throw CorruptError(where + ": the settings are not JSON (" + error.what() + ")");
  }
  base.views = Get<std::vector<std::string>>(base.settings, kViewsKey, where);
  return base;
}

// The first value of `group` that is another now; empty where all that matter are the same.
std::string FirstDifference(const Json& before, const Json& now, const std::string& group,
                            const std::function<bool(const std::string&)>& matters) {
  for (const auto& [key, value] : now.at(group).items()) {
    const Json had = before.at(group).value(key, Json());
    if (matters(key) && had != value) return group + "." + key + " is " + value.dump() + ", it was " + had.dump();
  }
  return {};
}

// Why a model trained with the settings `before` is none to go on from with those of `now`; empty where it is one.
std::string WhyAnew(const Json& before, const Json& now) {
  if (before.at("preset") != now.at("preset")) {
    return "its preset is " + before.at("preset").get<std::string>() + ", now it is " +
           now.at("preset").get<std::string>();
  }
  const auto field = [](const std::string& key) { return key != "corrected_views"; };
  const auto state = [](const std::string& key) {
    return key == "occupancy_resolution" || key == "step_voxels" || key == "unknown_background";
  };
  std::string difference = FirstDifference(before, now, "field", field);
  if (difference.empty()) difference = FirstDifference(before, now, "train", state);
  if (difference.empty() && before.at(kFrameKey) != now.at(kFrameKey)) difference = "it lies in another frame";
  return difference;
}

size_t NumAdded(const Base& base, const Json& settings) {
  size_t n_added = 0;
  for (const Json& id : settings.at(kViewsKey)) {
    const auto& views = base.views;
    n_added += std::find(views.begin(), views.end(), id.get<std::string>()) == views.end() ? 1 : 0;
  }
  return n_added;
}

// Goes on from the checkpoint in `dir` where there is one that can be used; tells why not where there is not.
void Resume(const std::filesystem::path& dir, const std::string& settings, const std::function<void()>& start_anew,
            std::optional<Trainer>& trainer) {
  if (!std::filesystem::exists(dir / kCheckpointFile)) return;
  try {
    LoadCheckpoint(dir, settings, trainer->state());
    trainer->StateChanged();
    ++trainer->state().resumed;
    LogInfo("training goes on from step " + std::to_string(trainer->state().step));
  } catch (const Error& error) {
    LogWarning(std::string(error.what()) + "; training starts anew");
    start_anew();
  }
}

// The first steps of a training with `small`, and what their speed says; the steps stay done.
Decision MeasureSmall(Trainer& trainer, bool unbounded, double budget_seconds) {
  const double enough = std::min(kMeasuredSeconds, kMeasuredFraction * budget_seconds);
  const TrainState& state = trainer.state();
  // The first steps, which know of no empty space yet, are no measure of the rest; of a slow machine there are no
  // others.
  int64_t n_slow = 0;
  double slow_seconds = 0;
  while (state.seconds < enough) {
    trainer.Step();
    if (state.step == kSlowSteps && state.seconds < 0.5 * enough) {
      n_slow = state.step;
      slow_seconds = state.seconds;
    }
  }
  const double rate = double(state.step - n_slow) / (state.seconds - slow_seconds);
  return needs::SmallModel(rate, budget_seconds, unbounded);
}

// Nothing when there is none that can be read.
std::optional<Decision> ReadChoice(const std::filesystem::path& dir) {
  try {
    return ReadJson(dir / kChoiceFile).get<Decision>();
  } catch (const std::exception&) {
    return std::nullopt;
  }
}

void WriteChoice(const std::filesystem::path& dir, const Decision& decision) {
  WriteFileAtomically(dir / kChoiceFile, Json(decision).dump());
}

void Evaluate(const HeldOutViews& held_out, Trainer& trainer) {
  TrainState& state = trainer.state();
  const auto start = Clock::now();
  trainer.Sync();
  const double psnr = held_out.Psnr([&](const View& view, const Rays& rays) { return trainer.RenderMean(view, rays); },
                                    [&](const View& view) { return trainer.Corrected(view); });
  if (std::isnan(psnr) || std::isnan(trainer.TrainPsnr())) {
    throw TrainingDiverged(std::string("the model shows colours that are no numbers in ") +
                           (std::isnan(psnr) ? "held-out views" : "every training batch") + " by step " +
                           std::to_string(state.step) + "; lower the preset's rates");
  }
  state.curve.push_back({state.seconds, state.step, state.samples, psnr, trainer.TrainPsnr()});
  state.seconds_evaluating += SecondsSince(start);
  LogInfo("step " + std::to_string(state.step) + ", " + FormatSeconds(state.seconds) + ": held-out " + Decibels(psnr) +
          ", training " + Decibels(trainer.TrainPsnr()));
}

void ShowProgress(const Trainer& trainer, double seconds_before, double progress_before, Progress& progress) {
  const double done = trainer.Progress();
  const double rate = (trainer.state().seconds - seconds_before) / (done - progress_before);
  progress.UpdateWithTimeLeft(100 * std::min(done, 1.), rate * std::max(0., 1 - done),
                              "training views " + Decibels(trainer.TrainPsnr()));
}

constexpr int kMostRollbacks = 3;
constexpr double kRateOfRollback = 0.5;
constexpr char kEvidenceFile[] = "diverged.json";

// Goes back to the last checkpoint, with smaller rates; what was spent stays spent. Throws what training met, with the
// evidence saved, when that was done `most` times.
void RollBack(const std::filesystem::path& dir, const std::string& settings, const TrainingDiverged& diverged, int most,
              Trainer& trainer) {
  TrainState& state = trainer.state();
  const int rollbacks = state.rollbacks + 1;
  const double seconds = state.seconds, rate_scale = kRateOfRollback * state.rate_scale;
  const int64_t n_skipped = state.n_skipped;
  if (rollbacks > most) {
    Json evidence = trainer.Evidence();
    evidence["met"] = diverged.what();
    WriteJson(dir / kEvidenceFile, evidence);
    throw InputError(
        std::string(diverged.what()) +
        (most > 0 ? "; this went on after " + std::to_string(most) + " returns to the last checkpoint with halved rates"
                  : std::string()) +
        ", see " + EscapePath(dir / kEvidenceFile));
  }
  LoadCheckpoint(dir, settings, state);
  state.rollbacks = rollbacks;
  state.rate_scale = rate_scale;
  state.seconds = seconds;
  state.n_skipped = n_skipped;
  state.n_skipped_in_row = 0;
  trainer.StateChanged();
  LogWarning(std::string(diverged.what()) + "; training goes on from step " + std::to_string(state.step) +
             " with rates divided by " + std::to_string(std::lround(1 / rate_scale)));
}

void TrainToTheEnd(Trainer& trainer, const HeldOutViews& held_out, const std::string& settings, bool check,
                   const ArtifactWriter& artifact) {
  TrainState& state = trainer.state();
  Progress progress("training", 100, "%");
  const double seconds_before = state.seconds, progress_before = trainer.Progress();
  double seconds_at_checkpoint = state.seconds;
  trainer.Sync();
  SaveCheckpoint(artifact.dir(), state, settings);  // what training can go back to at the least
  while (!trainer.Done()) {
    try {
      trainer.Step();
      ShowProgress(trainer, seconds_before, progress_before, progress);
      if (state.evaluations < kCurvePoints && trainer.Progress() >= CurveMoment(state.evaluations)) {
        while (state.evaluations < kCurvePoints && trainer.Progress() >= CurveMoment(state.evaluations))
          ++state.evaluations;
        if (!held_out.empty()) Evaluate(held_out, trainer);
      }
      if (state.seconds - seconds_at_checkpoint > kSecondsPerCheckpoint) trainer.Sync();  // may hear of skipped steps
      if (state.seconds - seconds_at_checkpoint > kSecondsPerCheckpoint && state.n_skipped_in_row == 0) {
        SaveCheckpoint(artifact.dir(), state, settings);
        artifact.SaveSeconds();
        seconds_at_checkpoint = state.seconds;
      }
      if (!trainer.Done()) continue;
      trainer.Sync();
      trainer.CheckState();  // what is kept is finite
    } catch (const TrainingDiverged& diverged) {
      RollBack(artifact.dir(), settings, diverged, check ? 0 : kMostRollbacks, trainer);
    }
  }
  progress.Done("training views " + Decibels(trainer.TrainPsnr()));
}

Json Curve(const TrainState& state) {
  Json curve = Json::array();
  for (const CurvePoint& point : state.curve) {
    curve.push_back({{"seconds", point.seconds},
                     {"steps", point.steps},
                     {"samples", point.samples},
                     {"psnr", point.psnr},
                     {"train_psnr", point.train_psnr}});
  }
  return curve;
}

// Of the pictures by the corrections, px: {"median", "largest"}, or null where cameras stayed as they were.
Json CameraDisplacement(const TrainState& state) {
  const std::vector<double>& moved = state.camera_displacements_px;
  if (moved.empty()) return {};
  return {{"median", Median(moved)}, {"largest", *std::max_element(moved.begin(), moved.end())}};
}

}  // namespace

Json DescribeTraining(const TrainingRequest& request) {
  const Decision device = ChooseDevice(request.device).decision;
  Json settings = Json::object(), steps;
  std::optional<Error> refused;
  for (const bool unbounded : {false, true}) {
    Json& kind = settings[unbounded ? "unbounded" : "bounded"];
    try {
      Preset preset = MakePreset(FirstPreset(request.preset), unbounded);
      ApplyRequest(request, preset);
      steps = preset.train.steps;
      kind = {{"field", ToJson(preset.field)}, {"train", ToJson(preset.train)}};
    } catch (const Error& error) {
      refused = error;
    }
  }
  if (steps.is_null()) throw Error(*refused);
  if (request.budget_seconds > 0) steps = nullptr;
  return {{"preset", ChoosesBySpeed(request) ? kAutoPreset : FirstPreset(request.preset)},
          {"device", device.needed ? "cuda" : "cpu"},
          {"steps", steps},
          {"budget_seconds", request.budget_seconds},
          {"decisions", {device}},
          {"settings", settings}};
}

void RunTraining(const TrainingRequest& request, const Params& params) {
  const Device device = ChooseDevice(request.device);
  const int n_threads = SetThreads(request.n_threads);
  const Manifest scene_manifest = RequireArtifact(request.scene_dir, "pose");
  const Scene scene = LoadScene(request.scene_dir);
  const ImagePack pack(request.scene_dir);
  const std::vector<SparseDepth> depths = LoadSparseDepths(scene, request.scene_dir);
  const TrainOptions options{
      .budget_seconds = request.budget_seconds, .seed = request.seed, .check = request.check, .gpu = device.gpu};

  std::vector<HashedPath> inputs = {ArtifactInput(request.scene_dir, scene_manifest)};
  if (!request.base.empty()) inputs.push_back(BaseInput(request.base));
  ArtifactWriter artifact("train", request.out, params, inputs, ArtifactWriter::kKeepPartial);
  artifact.SaveSeconds();
  std::optional<Trainer> trainer;
  std::optional<Base> base = ReadBase(request.base);
  std::string name = base && request.preset == kAutoPreset ? base->settings.at("preset").get<std::string>()
                                                           : FirstPreset(request.preset);
  Preset preset;
  Json settings, extended;
  std::vector<Decision> decisions;
  std::string why_anew;
  const auto start_anew = [&] {
    decisions = {device.decision};
    preset = ChoosePreset(request, name, scene, depths.size(), decisions);
    settings = Settings(request, name, preset, scene);
    TrainOptions own = options;
    if (base && why_anew.empty()) why_anew = WhyAnew(base->settings, settings);
    const size_t n_added = base ? NumAdded(*base, settings) : 0;
    const double share = base && why_anew.empty() ? needs::TrainingShare(settings.at(kViewsKey).size(), n_added) : 1;
    if (base) decisions.push_back(needs::TrainingAnew(why_anew, share));
    if (share < 1) {
      preset.train.steps = std::max<int64_t>(1, std::llround(share * double(preset.train.steps)));
      own.budget_seconds *= share;
      settings["train"] = ToJson(preset.train);
    }
    trainer.emplace(scene, pack, depths, preset, own);
    extended = nullptr;
    if (!base || !why_anew.empty()) return;
    trainer->Extend(request.base, base->training, base->views);
    extended = {{"steps_before", base->training.steps}, {"n_views_added", n_added}, {"share", share}};
    settings["extended"] = extended;
  };
  start_anew();
  if (base && !why_anew.empty()) {
    LogWarning("training starts anew: " + why_anew);
    if (ChoosesBySpeed(request) && name != FirstPreset(request.preset)) {
      name = FirstPreset(request.preset);
      start_anew();
    }
  }
  std::optional<Decision> small_model;
  if (ChoosesBySpeed(request) && extended.is_null()) {
    small_model = artifact.resumed() ? ReadChoice(artifact.dir()) : std::nullopt;
    const bool measured = !small_model;
    if (measured) small_model = MeasureSmall(*trainer, scene.unbounded, request.budget_seconds);
    if (!small_model->needed) {
      const double seconds = measured ? trainer->state().seconds : 0;
      name = "tiny";
      start_anew();
      trainer->state().seconds = seconds;  // measuring is part of the budget
    }
    if (measured) WriteChoice(artifact.dir(), *small_model);
    LogInfo("preset " + name + ": " + small_model->evidence + ", " + small_model->reason);
  }
  if (artifact.resumed()) Resume(artifact.dir(), settings.dump(), start_anew, trainer);
  const HeldOutViews held_out(scene, pack, BackgroundLevel(scene, preset.train.unknown_background));
  TrainToTheEnd(*trainer, held_out, settings.dump(), request.check, artifact);

  TrainState& state = trainer->state();
  Json told = settings;
  for (const char* key : {kFrameKey, kViewsKey, "extended"}) told.erase(key);
  state.SwapAverage();
  SaveModel(artifact.dir(), state, trainer->EvaluationOptions());
  state.SwapAverage();
  SaveCheckpoint(artifact.dir(), state, settings.dump());
  artifact.facts() = {{"steps", state.step},
                      {"samples", state.samples},
                      {"preset", name},
                      {"settings", told},
                      {"extended", extended},
                      {"curve", Curve(state)},
                      {"curve_protocol", held_out.Protocol()},
                      {"train_psnr", trainer->TrainPsnr()},
                      {"seconds_training", state.seconds},
                      {"seconds_evaluating", state.seconds_evaluating},
                      {"steps_per_second", double(state.step) / state.seconds},
                      {"camera_displacement_px", CameraDisplacement(state)},
                      {"steps_skipped", state.n_skipped},
                      {"rollbacks", state.rollbacks},
                      {"device", device.gpu ? "cuda" : "cpu"},
                      {"threads", n_threads},
                      {"n_parameters", state.field.n_parameters()},
                      {"occupied_fraction", state.occupancy.OccupiedFraction()},
                      {"resumed", state.resumed}};
  Decision camera_correction = needs::CameraCorrection(
      state.camera_first_px < 0 ? std::nullopt : std::optional(state.camera_first_px), preset.train.camera_least_px);
  Force(camera_correction, request.camera_correction);
  decisions.push_back(camera_correction);
  if (!state.cameras.poses.empty()) {
    WriteJson(artifact.dir() / kCamerasFile, CorrectedCamerasJson(scene, state.cameras, state.camera_displacements_px));
    artifact.AddOutput(kCamerasFile);
  }
  if (small_model) decisions.push_back(*small_model);
  for (const Decision& decision : decisions) artifact.AddDecision(decision);
  artifact.AddOutput(kModelFile);
  artifact.Commit();
}

}  // namespace nrff
