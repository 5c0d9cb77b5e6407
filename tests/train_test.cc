// Laws of training: it improves, it can be stopped and go on without a trace, and what is damaged is not trusted.

#include <ATen/ATen.h>
#include <c10/core/GradMode.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <fstream>
#include <numbers>

#include "model/checkpoint.h"
#include "model/depth_batch.h"
#include "model/grid_crop.h"
#include "model/held_out.h"
#include "model/losses.h"
#include "model/schedule.h"
#include "model/trainer.h"
#include "model/training.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "render/compute.h"
#include "tests/temporary_directory.h"

namespace nrff {
namespace {

using ::testing::HasSubstr;
using torch::Tensor;

constexpr int kSize = 32;  // px

// What a camera at `eye` looking at the origin sees of a shaded ball of radius 0.5: RGBA.
std::vector<uint8_t> BallImage(const View& view) {
  std::vector<uint8_t> pixels;
  const Mat4& m = view.scene_from_camera;
  for (int y = 0; y < kSize; ++y) {
    for (int x = 0; x < kSize; ++x) {
      const double camera[3] = {(x + 0.5 - view.cx) / view.fx, (y + 0.5 - view.cy) / view.fy, 1};
      double d[3], o[3] = {m[3], m[7], m[11]}, dd = 0, od = 0, oo = 0;
      for (int k = 0; k < 3; ++k) {
        d[k] = m[4 * k] * camera[0] + m[4 * k + 1] * camera[1] + m[4 * k + 2] * camera[2];
        dd += d[k] * d[k];
        od += o[k] * d[k];
        oo += o[k] * o[k];
      }
      const double root = od * od - dd * (oo - 0.25);
      const bool hit = root > 0;
      const double t = hit ? (-od - std::sqrt(root)) / dd : 0;
      for (int k = 0; k < 3; ++k) {
        const double normal = 2 * (o[k] + t * d[k]);
        pixels.push_back(hit ? uint8_t(std::lround(127.5 + 100 * normal)) : 0);
      }
      pixels.push_back(hit ? 255 : 0);
    }
  }
  return pixels;
}

// Six views of the ball around the equator to train on, two above to hold out.
Scene WriteBallScene(const std::filesystem::path& dir) {
  Scene scene;
  scene.name = "ball";
  scene.background = Background::kWhite;
  scene.near = 0.5;
  scene.far = 5;
  scene.scene_from_world = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
  std::ofstream pack(dir / kPackFile, std::ios::binary);
  for (int i = 0; i < 8; ++i) {
    const double azimuth = 2 * std::numbers::pi * i / 6, height = i < 6 ? 0.5 * (i % 2) : 1;
    const double norm = std::sqrt(1 + height * height), c = std::cos(azimuth), s = std::sin(azimuth);
    const double z[3] = {-c / norm, -s / norm, -height / norm}, right[3] = {-s, c, 0};
    const double down[3] = {z[1] * right[2] - z[2] * right[1], z[2] * right[0] - z[0] * right[2],
                            z[0] * right[1] - z[1] * right[0]};
    View view;
    view.id = "00000" + std::to_string(i);
    view.name = view.id + ".png";
    view.split = i < 6 ? Split::kTrain : Split::kTest;
    view.width = view.height = kSize;
    view.channels = 4;
    view.pack_offset = uint64_t(i) * kSize * kSize * 4;
    view.fx = view.fy = 1.5 * kSize;
    view.cx = view.cy = kSize / 2.;
    view.scene_from_camera = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1};
    for (int k = 0; k < 3; ++k) {
      view.scene_from_camera[4 * k] = right[k];
      view.scene_from_camera[4 * k + 1] = down[k];
      view.scene_from_camera[4 * k + 2] = z[k];
      view.scene_from_camera[4 * k + 3] = -2 * z[k];
    }
    scene.views.push_back(view);
    const std::vector<uint8_t> pixels = BallImage(view);
    pack.write(reinterpret_cast<const char*>(pixels.data()), std::streamsize(pixels.size()));
  }
  pack.close();
  SaveScene(scene, dir);
  SaveSparseDepths({}, dir);
  return scene;
}

// Points of the ball's front on rays of the training views.
std::vector<SparseDepth> BallDepths(const Scene& scene) {
  std::vector<SparseDepth> depths;
  for (const int v : scene.ViewsOf(Split::kTrain)) {
    const Mat4& m = scene.views[v].scene_from_camera;
    const double norm = std::sqrt(m[3] * m[3] + m[7] * m[7] + m[11] * m[11]);
    for (const double lean : {-0.6, -0.3, 0., 0.3, 0.6}) {  // radians from the direction of the camera
      SparseDepth depth{uint32_t(v), {}, 0.005F};
      for (int k = 0; k < 3; ++k)
        depth.position[k] = float(0.5 * (std::cos(lean) * m[4 * k + 3] / norm + std::sin(lean) * m[4 * k]));
      depths.push_back(depth);
    }
  }
  return depths;
}

Preset TestPreset(int64_t steps) {
  Preset preset = MakePreset("tiny", false);
  preset.field.levels = 2;
  preset.field.max_resolution = 24;
  preset.field.spatial_width = preset.field.directional_width = 16;
  preset.field.lobes_theta = 3;
  preset.field.lobes_phi = 4;
  preset.train.steps = steps;
  preset.train.rays = 256;
  preset.train.max_rays = 512;
  preset.train.target_shaded = 1024;
  preset.train.occupancy_resolution = 32;
  preset.train.occupancy_cells = 2048;
  preset.train.step_voxels = {16, 32};
  preset.train.step_moments = {0.2};
  return preset;
}

class TrainTest : public ::testing::Test {
 protected:
  TrainTest() : scene_(WriteBallScene(directory_.path())), pack_(directory_.path()) { SetThreads(1); }

  double HeldOutPsnr(const Trainer& trainer) const {
    const TrainState& state = trainer.state();
    return HeldOutViews(scene_, pack_, 1).Psnr(state.field, state.occupancy, state.map, trainer.EvaluationOptions());
  }
  // The bytes that SaveModel writes for the state.
  std::string ModelBytes(const Trainer& trainer) const {
    const TemporaryDirectory out;
    SaveModel(out.path(), trainer.state(), trainer.EvaluationOptions());
    return ReadFile(out.path() / kModelFile);
  }

  TemporaryDirectory directory_;
  Scene scene_;
  ImagePack pack_;
};

TEST_F(TrainTest, ImprovesOnViewsItHasNotSeen) {
  Trainer trainer(scene_, pack_, {}, TestPreset(300), {});
  const double before = HeldOutPsnr(trainer);
  while (!trainer.Done()) trainer.Step();
  const double after = HeldOutPsnr(trainer);
  EXPECT_GT(after, before + 8);
  EXPECT_GT(after, 20);
  EXPECT_EQ(trainer.state().n_skipped, 0);
  EXPECT_LT(trainer.state().occupancy.OccupiedFraction(), 0.7);
}

TEST_F(TrainTest, StoppedAndResumedGivesTheSameBitsAsNeverStopped) {
  Preset preset = TestPreset(60);  // the step changes, occupancy is updated and the box shrinks on the way
  preset.train.depth_weight = 0.1;
  preset.train.average_from = 0.6;
  preset.train.average_interval = 5;
  const std::vector<SparseDepth> depths = BallDepths(scene_);
  Trainer whole(scene_, pack_, depths, preset, {.seed = 3});
  while (!whole.Done()) whole.Step();
  EXPECT_GT(whole.state().shrink_moments_done, 0);
  EXPECT_GT(whole.state().n_averaged, 2);
  whole.state().SwapAverage();
  for (const int64_t stop : {1, 15, 16, 37, 44}) {
    const TemporaryDirectory out;
    {
      Trainer first(scene_, pack_, depths, preset, {.seed = 3});
      while (first.state().step < stop) first.Step();
      SaveCheckpoint(out.path(), first.state(), "settings");
    }
    Trainer second(scene_, pack_, depths, preset, {.seed = 3});
    LoadCheckpoint(out.path(), "settings", second.state());
    EXPECT_EQ(second.state().step, stop);
    while (!second.Done()) second.Step();
    second.state().SwapAverage();
    EXPECT_EQ(ModelBytes(second), ModelBytes(whole)) << "stopped after step " << stop;
    EXPECT_EQ(second.state().samples, whole.state().samples);
    EXPECT_EQ(second.TrainPsnr(), whole.TrainPsnr());
  }
}

// From average_from on, of every average_interval-th step.
TEST_F(TrainTest, AverageIsTheMeanOfTheParametersOnTheWay) {
  Preset preset = TestPreset(60);
  preset.train.average_from = 0.5;
  preset.train.average_interval = 4;
  Trainer trainer(scene_, pack_, {}, preset, {.seed = 3});
  std::vector<Tensor> sums;
  int n = 0;
  while (!trainer.Done()) {
    trainer.Step();
    const int64_t step = trainer.state().step - 1;
    if (step < 30 || step % 4 != 0) continue;
    ++n;
    for (size_t i = 0; i < trainer.state().field.parameters().size(); ++i) {
      const Tensor value = trainer.state().field.parameters()[i].value.detach().to(torch::kDouble);
      if (n == 1) {
        sums.push_back(value.clone());
      } else {
        sums[i] += value;
      }
    }
  }
  EXPECT_EQ(trainer.state().n_averaged, n);
  const std::string last = ModelBytes(trainer);
  trainer.state().SwapAverage();
  for (size_t i = 0; i < sums.size(); ++i) {
    const Tensor value = trainer.state().field.parameters()[i].value.detach();
    EXPECT_LT((value - sums[i] / n).abs().max().item<double>(), 1e-6 * (1 + (sums[i] / n).abs().max().item<double>()));
  }
  EXPECT_NE(ModelBytes(trainer), last);
  trainer.state().SwapAverage();
  EXPECT_EQ(ModelBytes(trainer), last);
}

TEST_F(TrainTest, AnotherSeedGivesAnotherModel) {
  Trainer a(scene_, pack_, {}, TestPreset(2), {.seed = 1}), b(scene_, pack_, {}, TestPreset(2), {.seed = 2});
  EXPECT_NE(ModelBytes(a), ModelBytes(b));
}

TEST_F(TrainTest, HeldOutPixelsChangeNothing) {
  const TemporaryDirectory other;
  const Scene scene = WriteBallScene(other.path());
  const uint64_t begin = scene.views[6].pack_offset;
  std::fstream pack(other.path() / kPackFile, std::ios::in | std::ios::out | std::ios::binary);
  pack.seekp(std::streamoff(begin));
  pack << std::string(2 * kSize * kSize * 4, '\x55');
  pack.close();
  const ImagePack other_pack(other.path());
  Trainer a(scene_, pack_, {}, TestPreset(20), {}), b(scene, other_pack, {}, TestPreset(20), {});
  while (!a.Done()) a.Step();
  while (!b.Done()) b.Step();
  EXPECT_EQ(ModelBytes(a), ModelBytes(b));
}

TEST_F(TrainTest, ModelReadBackShowsTheSame) {
  Trainer trainer(scene_, pack_, {}, TestPreset(40), {});
  while (!trainer.Done()) trainer.Step();
  const TemporaryDirectory out;
  SaveModel(out.path(), trainer.state(), trainer.EvaluationOptions());
  const std::unique_ptr<LoadedModel> model = LoadModel(out.path());
  EXPECT_EQ(model->field->config(), trainer.preset().field);
  const HeldOutViews held_out(scene_, pack_, 1);
  const TrainState& state = trainer.state();
  EXPECT_EQ(held_out.Psnr(*model->field, model->occupancy, model->map, model->options),
            held_out.Psnr(state.field, state.occupancy, state.map, trainer.EvaluationOptions()));
}

TEST_F(TrainTest, NothingThatIsNotFiniteIsWritten) {
  Trainer trainer(scene_, pack_, {}, TestPreset(10), {});
  trainer.Step();
  const TemporaryDirectory out;
  SaveCheckpoint(out.path(), trainer.state(), "");
  const std::string before = ReadFile(out.path() / kCheckpointFile);
  trainer.state().adam_v[3].fill_(INFINITY);
  EXPECT_THROW(SaveCheckpoint(out.path(), trainer.state(), ""), Error);
  EXPECT_EQ(ReadFile(out.path() / kCheckpointFile), before);
}

TEST_F(TrainTest, StepsThatAreNotFiniteAreSkippedAndManyInARowEndWithTheEvidence) {
  Trainer trainer(scene_, pack_, {}, TestPreset(100), {});
  trainer.Step();
  {
    const c10::NoGradGuard no_grad;
    trainer.state().field.parameters().back().value.fill_(NAN);  // the last bias: every colour
  }
  const Tensor grid = trainer.state().field.parameters()[0].value.detach().clone();
  try {
    for (int i = 0; i < Trainer::kMostSkipped; ++i) trainer.Step();
    FAIL() << "went on";
  } catch (const Error& error) {
    EXPECT_THAT(error.what(), HasSubstr("a loss that is not a number"));
  }
  EXPECT_EQ(trainer.state().n_skipped, Trainer::kMostSkipped);
  EXPECT_TRUE(at::equal(grid, trainer.state().field.parameters()[0].value.detach()));
}

TEST_F(TrainTest, CheckFindsWhatLossesAndGradientsDoNotShow) {
  for (const bool check : {false, true}) {
    Trainer trainer(scene_, pack_, {}, TestPreset(10), {.check = check});
    trainer.Step();
    trainer.state().adam_v[1].fill_(INFINITY);
    if (!check) {
      trainer.Step();
      continue;
    }
    try {
      trainer.Step();
      FAIL() << "went on";
    } catch (const TrainingDiverged& diverged) {
      EXPECT_THAT(diverged.what(), HasSubstr("a non-finite second moment in level 0 ("));
      EXPECT_THAT(diverged.what(), HasSubstr("of appearance_grid at step 1"));
    }
  }
}

TEST_F(TrainTest, ABoxWithoutSizeIsRefused) {
  scene_.aabb_max[1] = scene_.aabb_min[1];
  EXPECT_THROW(Trainer(scene_, pack_, {}, TestPreset(10), {}), Error);
}

TEST_F(TrainTest, ACameraThatIsNotFiniteIsRefusedByName) {
  scene_.views[2].scene_from_camera[3] = NAN;
  try {
    const Trainer trainer(scene_, pack_, {}, TestPreset(10), {});
    FAIL() << "was accepted";
  } catch (const Error& error) {
    EXPECT_EQ(error.code(), ExitCode::kInput);
    EXPECT_THAT(error.what(), HasSubstr("000002.png"));
  }
}

TEST_F(TrainTest, ADamagedOrForeignCheckpointIsRefused) {
  Trainer trainer(scene_, pack_, {}, TestPreset(10), {});
  const TemporaryDirectory out;
  SaveCheckpoint(out.path(), trainer.state(), "these");
  EXPECT_THROW(LoadCheckpoint(out.path(), "those", trainer.state()), Error);
  const std::string bytes = ReadFile(out.path() / kCheckpointFile);
  for (const double part : {0., 0.1, 0.5, 0.999}) {
    std::ofstream(out.path() / kCheckpointFile, std::ios::binary)
        << bytes.substr(0, size_t(part * double(bytes.size())));
    EXPECT_THROW(LoadCheckpoint(out.path(), "these", trainer.state()), Error) << part;
  }
}

TEST_F(TrainTest, ABudgetThatStepsDoNotDivideEndsOnTheNearerSide) {
  Trainer one(scene_, pack_, {}, TestPreset(1'000'000), {.budget_seconds = 1e-6});
  EXPECT_FALSE(one.Done());
  one.Step();
  EXPECT_TRUE(one.Done());
  Trainer trainer(scene_, pack_, {}, TestPreset(1'000'000), {.budget_seconds = 10});
  trainer.Step();
  const double step = trainer.state().seconds;
  trainer.state().seconds = 10 - 0.6 * step;
  EXPECT_FALSE(trainer.Done());
  trainer.state().seconds = 10 - 0.4 * step;
  EXPECT_TRUE(trainer.Done());
}

TEST_F(TrainTest, ABudgetOfSecondsEndsTheTraining) {
  Trainer trainer(scene_, pack_, {}, TestPreset(1'000'000), {.budget_seconds = 0.5});
  double before = 0, last = 0, longest = 0;
  while (!trainer.Done()) {
    trainer.Step();
    last = trainer.state().seconds - before;
    longest = std::max(longest, last);
    before = trainer.state().seconds;
  }
  EXPECT_GE(trainer.state().seconds, 0.5 - 0.5 * last - 1e-9);
  EXPECT_LE(trainer.state().seconds, 0.5 + longest);
  EXPECT_LT(trainer.state().step, 1'000'000);
  EXPECT_EQ(trainer.state().step_stage, 1);  // the schedule went with it
}

// The whole stage, twice into the same place: the second time a damaged checkpoint lies there.
// The stage as nrff-train runs it.
class TrainStage : public TrainTest {
 protected:
  TrainStage() {
    ArtifactWriter scene_artifact("pose", directory_.path() / "pose", {}, {});
    WriteBallScene(scene_artifact.dir());
    SaveSparseDepths(BallDepths(scene_), scene_artifact.dir());
    for (const char* output : {kSceneFile, kPackFile, kDepthFile}) scene_artifact.AddOutput(output);
    scene_artifact.Commit();
    request.scene_dir = directory_.path() / "pose";
    request.out = directory_.path() / "train";
    request.preset = "tiny";
    request.steps = 12;
    request.n_threads = 1;
  }

  TrainingRequest request;
};

TEST_F(TrainStage, SettingsAndForcedDecisionsAreInTheModelAndTheManifest) {
  request.settings = "field.levels=3 train.depth_rays=16";
  request.fine_levels = false;
  request.sparse_depth = true;
  RunTraining(request, {});
  const Manifest manifest = RequireArtifact(request.out, "train");
  const Json& settings = manifest.facts.at("settings");
  EXPECT_EQ(settings.at("train").at("depth_rays"), 16);
  EXPECT_GT(settings.at("train").at("depth_weight"), 0);
  EXPECT_EQ(settings.at("field").at("max_resolution"), 32) << "an octave below tiny's 64";
  EXPECT_EQ(settings.at("field").at("levels"), 2);
  for (const Decision& decision : manifest.decisions) {
    if (decision.feature == "cuda") continue;
    EXPECT_EQ(decision.reason, "forced by an option") << decision.feature;
  }
}

// On this scene 1e4 is just too much and a quarter of it is not.
TEST_F(TrainStage, GoesBackWithSmallerRatesWhenTheyExplode) {
  request.steps = 60;
  request.settings = "train.network_rate=1e4 train.grid_rate=1e4";
  RunTraining(request, {});
  const Json facts = RequireArtifact(request.out, "train").facts;
  EXPECT_GT(facts.at("rollbacks"), 0);
  EXPECT_EQ(facts.at("steps"), 60);
}

TEST_F(TrainStage, SaysWhatItMetWhenGoingBackDoesNotHelp) {
  request.settings = "train.network_rate=1e20 train.grid_rate=1e20";
  request.steps = 60;
  try {
    RunTraining(request, {});
    FAIL() << "ended";
  } catch (const Error& error) {
    EXPECT_EQ(error.code(), ExitCode::kInput);
    EXPECT_THAT(error.what(), HasSubstr("after 3 returns to the last checkpoint"));
    EXPECT_THAT(error.what(), HasSubstr("diverged.json"));
  }
  const Json evidence = ReadJson(request.out.string() + ".partial/diverged.json");
  EXPECT_EQ(evidence.at("rollbacks"), 3);
  EXPECT_EQ(evidence.at("rate_scale"), 0.125);
  EXPECT_GT(evidence.at("parameters").at(0).at("largest"), 1e10);
  EXPECT_FALSE(std::filesystem::exists(request.out));
}

TEST_F(TrainStage, CheckEndsAtTheFirstNumberThatIsNotFinite) {
  request.settings = "train.network_rate=1e20 train.grid_rate=1e20";
  request.check = true;
  try {
    RunTraining(request, {});
    FAIL() << "ended";
  } catch (const Error& error) {
    EXPECT_THAT(error.what(), HasSubstr("colours that are no numbers in held-out views by step 1; "));
  }
  EXPECT_EQ(ReadJson(request.out.string() + ".partial/diverged.json").at("rollbacks"), 0);
}

// Fewer steps than are left out before training goes back: what the held-out views show tells.
TEST_F(TrainStage, AShortTrainingThatExplodesIsNoModelEither) {
  request.settings = "train.network_rate=1e20 train.grid_rate=1e20";
  request.steps = 8;
  EXPECT_THROW(RunTraining(request, {}), Error);
  EXPECT_TRUE(std::filesystem::exists(request.out.string() + ".partial/diverged.json"));
}

TEST_F(TrainStage, TheDirectionalEncodingIsGivenOnce) {
  request.settings = "field.directional_encoding=\"pe\"";
  request.directional = "none";
  EXPECT_THROW(RunTraining(request, {}), Error);
}

TEST_F(TrainStage, SaturatedDensityIsNoFailure) {
  request.settings = "field.density_shift=1e4";
  RunTraining(request, {});
  const Json facts = RequireArtifact(request.out, "train").facts;
  EXPECT_EQ(facts.at("rollbacks"), 0);
  EXPECT_EQ(facts.at("steps_skipped"), 0);
}

TEST_F(TrainStage, ABudgetTooShortForSmallTakesTiny) {
#ifdef __SANITIZE_ADDRESS__
  constexpr int kBudget = 10;  // one step takes half a second there
#else
  constexpr int kBudget = 1;
#endif
  request.preset = kAutoPreset;
  request.steps = 0;
  request.budget_seconds = kBudget;
  RunTraining(request, {});
  const Manifest manifest = RequireArtifact(request.out, "train");
  EXPECT_EQ(manifest.facts.at("preset"), "tiny");
  EXPECT_NEAR(manifest.facts.at("seconds_training").get<double>() / kBudget, 1, 0.2);
  const Decision& decision = manifest.decisions.back();
  EXPECT_EQ(decision.feature, "small_model");
  EXPECT_FALSE(decision.needed);
  EXPECT_THAT(decision.evidence, HasSubstr("steps of the preset small fit in " + std::to_string(kBudget) + " s"));
  EXPECT_TRUE(needs::SmallModel(100, 10, /*unbounded=*/false).needed);
  EXPECT_FALSE(needs::SmallModel(100, 10, /*unbounded=*/true).needed);
}

// Measured again, this budget would give tiny.
TEST_F(TrainStage, GoesOnWithThePresetThatWasChosenBeforeItWasStopped) {
  request.preset = kAutoPreset;
  request.steps = 0;
  request.budget_seconds = 1;
  const Decision chosen{"small_model", true, "100 steps", "10 steps", "chosen before"};
  {
    const ArtifactWriter interrupted("train", request.out, {},
                                     {ArtifactInput(request.scene_dir, RequireArtifact(request.scene_dir, "pose"))},
                                     ArtifactWriter::kKeepPartial);
    interrupted.SaveSeconds();
    WriteFileAtomically(interrupted.dir() / "preset.json", Json(chosen).dump());
  }
  RunTraining(request, {});
  const Manifest manifest = RequireArtifact(request.out, "train");
  EXPECT_EQ(manifest.facts.at("preset"), "small");
  EXPECT_EQ(manifest.decisions.back().reason, chosen.reason);
}

TEST_F(TrainStage, StartsAnewAfterADamagedCheckpoint) {
  RunTraining(request, {{"steps", "12"}});
  const Manifest manifest = RequireArtifact(request.out, "train");
  EXPECT_EQ(manifest.facts.at("steps"), 12);
  EXPECT_FALSE(manifest.facts.at("curve").empty());
  EXPECT_EQ(manifest.facts.at("settings").at("train").at("steps"), 12);
  const std::string model = ReadFile(request.out / kModelFile);

  {
    const ArtifactWriter interrupted("train", request.out, {{"steps", "12"}},
                                     {ArtifactInput(request.scene_dir, RequireArtifact(request.scene_dir, "pose"))},
                                     ArtifactWriter::kKeepPartial);
    interrupted.SaveSeconds();
    std::ofstream(interrupted.dir() / kCheckpointFile) << "not a checkpoint";
  }
  RunTraining(request, {{"steps", "12"}});
  EXPECT_EQ(RequireArtifact(request.out, "train").facts.at("resumed"), 0);
  EXPECT_EQ(ReadFile(request.out / kModelFile), model);
}

TEST(CropGrid, KeepsWhatIsLinearAndIsTheIdentityForTheWholeBox) {
  const GridLayout layout = MakeGridLayout(2, 4, 7, 2);
  const Tensor random = at::rand({layout.n_parameters}, torch::kDouble);
  EXPECT_TRUE(at::allclose(CropGrid(layout, random, {-1, -1, -1}, {1, 1, 1}), random, 0, 1e-15));

  // Factors that are linear: nodes (i, j) hold 1 + i and so on in node units of each level.
  Tensor linear = at::empty({layout.n_parameters}, torch::kDouble);
  for (const auto& level : layout.levels) {
    const int64_t n = level.resolution;
    const Tensor node = at::linspace(-1, 1, n, torch::kDouble);
    for (int p = 0; p < 3; ++p) {
      const Tensor plane = (node.view({1, n, 1}) + 2 * node.view({n, 1, 1}) + 5).expand({n, n, 2});
      linear.narrow(0, level.plane_offsets[p], n * n * 2).copy_(plane.reshape({-1}));
      linear.narrow(0, level.line_offsets[p], n * 2).copy_((3 - node).unsqueeze(1).expand({n, 2}).reshape({-1}));
    }
  }
  const std::array<double, 3> min{-0.6, -0.2, 0.1}, max{0.3, 0.9, 0.7};
  const Tensor cropped = CropGrid(layout, linear, min, max);
  const Tensor inner = at::rand({40, 3}, torch::kDouble) * 2 - 1;
  Tensor outer = at::empty_like(inner);
  for (int k = 0; k < 3; ++k) {
    outer.select(1, k).copy_(min[k] + (inner.select(1, k) + 1) / 2 * (max[k] - min[k]));
  }
  std::vector<double> before(40), after(40);
  GridSumForward(layout, linear.const_data_ptr<double>(), outer.const_data_ptr<double>(), 40, before.data());
  GridSumForward(layout, cropped.const_data_ptr<double>(), inner.const_data_ptr<double>(), 40, after.data());
  for (int i = 0; i < 40; ++i) EXPECT_NEAR(after[i], before[i], 1e-12);
}

TEST(DepthLossTest, IsTheLightThatDoesNotEndAtTheSurface) {
  const auto kDouble = torch::kDouble;
  const Tensor weights = at::tensor({0.2, 0.5, 0.1, 0.4}, kDouble).requires_grad_(true);
  const Tensor t = at::tensor({1., 2., 3., 5.}, kDouble);
  const Tensor ray = at::tensor({0, 0, 0, 2}, torch::kLong);  // the second of three rays meets nothing
  const Tensor distance = at::tensor({2., 4., 4.}, kDouble), spread = at::tensor({0.5, 1., 2.}, kDouble);
  const Tensor loss = DepthLoss(weights, t, ray, distance, spread);
  const double k[] = {std::exp(-2.), 1, std::exp(-2.), std::exp(-0.125)};
  EXPECT_NEAR(loss.item<double>(), 1 - (0.2 * k[0] + 0.5 * k[1] + 0.1 * k[2] + 0.4 * k[3]) / 3, 1e-15);
  loss.backward();
  for (int i = 0; i < 4; ++i) EXPECT_NEAR(weights.grad()[i].item<double>(), -k[i] / 3, 1e-15);
}

TEST_F(TrainTest, SparseDepthsBringTheSurfaceToWhereTheyAre) {
  const std::vector<SparseDepth> depths = BallDepths(scene_);
  const DepthSource source(scene_, depths);
  const auto missed_light = [&](double weight) {
    Preset preset = TestPreset(150);
    preset.train.depth_weight = weight;
    Trainer trainer(scene_, pack_, depths, preset, {});
    while (!trainer.Done()) trainer.Step();
    const c10::NoGradGuard no_grad;
    const TrainState& state = trainer.state();
    const RenderOptions options = trainer.EvaluationOptions();
    const DepthSource::Batch batch = source.Draw(256, 5, 0, state.map, options.step);
    const Samples samples = MarchRays(state.occupancy, state.map, batch.rays, options);
    const Visibility visibility = MeasureVisibility(state.field, samples, options.stop_transmittance);
    return DepthLoss(visibility.weights, samples.t, samples.ray_index, batch.distance, batch.spread).item<double>();
  };
  const double with = missed_light(0.1), without = missed_light(0);
  EXPECT_LT(with, 0.7 * without) << "with " << with << ", without " << without;
}

}  // namespace
}  // namespace nrff
