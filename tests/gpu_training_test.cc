// Training on a GPU by the same laws as on the CPU, in the emulation of tests/emulation where there is none.

#include <ATen/ATen.h>
#include <c10/core/GradMode.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "model/camera_corrections.h"
#include "model/cuda/gpu_renderer.h"
#include "tests/ball_scene.h"
#include "tests/gpu_under_test.h"

namespace nrff {
namespace {

using ::testing::HasSubstr;

class GpuTraining : public TrainTest {
 protected:
  void SetUp() override {
    if (!GpuIsThere()) GTEST_SKIP() << "there is no GPU";
    LimitGpuMemory(size_t{1} << 34);
  }
  const TrainOptions options_{.seed = 3, .gpu = GpuUnderTest()};
};

// With bf16 networks and tables of halfs. The step changes and the box shrinks on the way.
TEST_F(GpuTraining, LearnsWhatTheCpuLearns) {
  Preset preset = BallPreset(120);
  preset.train.depth_weight = 0.05;
  preset.train.average_from = 0.6;
  preset.train.average_interval = 5;
  const std::vector<SparseDepth> depths = BallDepths(scene_);
  const auto train = [&](const TrainOptions& options) {
    Trainer trainer(scene_, pack_, depths, preset, options);
    while (!trainer.Done()) trainer.Step();
    trainer.Sync();
    trainer.CheckState();
    EXPECT_EQ(trainer.state().n_skipped, 0);
    EXPECT_EQ(trainer.state().shrink_moments_done, 1);
    EXPECT_GT(trainer.state().adam_t, 100);
    EXPECT_GT(trainer.state().samples, 100000);
    trainer.state().SwapAverage();
    return HeldOutPsnr(trainer);
  };
  const double on_cpu = train({.seed = 3}), on_gpu = train(options_);
  EXPECT_GT(on_cpu, 20);
  EXPECT_NEAR(on_gpu, on_cpu, 0.5);
}

TEST_F(GpuTraining, SeesThroughCamerasThatWereMoved) {
  CameraCorrections moved = CameraCorrections::None(scene_.views);
  for (PoseCorrection& pose : moved.poses) pose.turn = {0.05, -0.03, 0.02};
  Scene elsewhere = scene_;
  for (View& view : elsewhere.views) view = moved.Corrected(view);
  const Preset preset = BallPreset(60);
  Trainer corrected(scene_, pack_, {}, preset, options_), given(elsewhere, pack_, {}, preset, options_),
      unmoved(scene_, pack_, {}, preset, options_);
  corrected.state().cameras = moved;
  corrected.StateChanged();
  for (Trainer* trainer : {&corrected, &given, &unmoved}) {
    trainer->Step();
    trainer->Sync();
  }
  EXPECT_EQ(corrected.TrainPsnr(), given.TrainPsnr());
  EXPECT_NE(corrected.TrainPsnr(), unmoved.TrainPsnr());
}

TEST_F(GpuTraining, CorrectsCamerasAsTheCpuDoes) {
  Preset preset = BallPreset(120);
  preset.train.camera_moments = {0.5};
  preset.train.camera_least_px = 0;
  CameraCorrections errors = CameraCorrections::None(scene_.views);
  for (size_t i = 0; i < errors.poses.size(); ++i) errors.poses[i].turn = {i % 2 == 0 ? 0.02 : -0.02, 0, 0};
  Scene wrong = scene_;
  for (View& view : wrong.views) view = errors.Corrected(view);
  Trainer on_cpu(wrong, pack_, {}, preset, {.seed = 3}), on_gpu(wrong, pack_, {}, preset, options_);
  while (on_cpu.Progress() < 0.5) on_cpu.Step();
  const TemporaryDirectory out;
  SaveCheckpoint(out.path(), on_cpu.state(), "settings");
  LoadCheckpoint(out.path(), "settings", on_gpu.state());
  on_gpu.StateChanged();
  on_cpu.Step();
  on_gpu.Step();
  const auto &of_cpu = on_cpu.state().cameras.poses, &of_gpu = on_gpu.state().cameras.poses;
  ASSERT_EQ(of_cpu.size(), 6u);
  ASSERT_EQ(of_gpu.size(), 6u);
  double largest = 0;
  for (size_t i = 0; i < of_cpu.size(); ++i) {
    for (size_t k = 0; k < 3; ++k) {
      EXPECT_NEAR(of_gpu[i].turn[k], of_cpu[i].turn[k], 1e-3);  // but for rounding to bf16
      largest = std::max(largest, std::abs(of_cpu[i].turn[k]));
    }
  }
  EXPECT_GT(largest, 5e-3);
}

TEST_F(GpuTraining, GoesOnFromItsCheckpoint) {
  const Preset preset = BallPreset(60);
  const TemporaryDirectory out;
  {
    Trainer first(scene_, pack_, {}, preset, options_);
    while (first.state().step < 30) first.Step();
    first.Sync();
    SaveCheckpoint(out.path(), first.state(), "settings");
  }
  Trainer second(scene_, pack_, {}, preset, options_), on_cpu(scene_, pack_, {}, preset, {.seed = 3});
  for (Trainer* trainer : {&second, &on_cpu}) {
    LoadCheckpoint(out.path(), "settings", trainer->state());
    trainer->StateChanged();
    trainer->Step();
    trainer->Sync();
  }
  // One step from the same place leads to the same place, but for rounding to bf16.
  for (size_t i = 0; i < second.state().adam_m.size(); ++i) {
    const torch::Tensor difference = second.state().adam_m[i] - on_cpu.state().adam_m[i];
    EXPECT_LT(difference.norm().item<double>(), 0.02 * on_cpu.state().adam_m[i].norm().item<double>());
  }
  EXPECT_EQ(second.state().adam_t, on_cpu.state().adam_t);
  EXPECT_EQ(second.state().step, 31);
}

TEST_F(GpuTraining, StepsThatAreNotFiniteChangeNothingAndAreNamed) {
  Trainer trainer(scene_, pack_, {}, BallPreset(60), options_);
  for (int i = 0; i < 3; ++i) trainer.Step();
  trainer.Sync();
  const c10::NoGradGuard no_grad;
  torch::Tensor bias = trainer.state().field.parameters().back().value;
  const torch::Tensor before = trainer.state().field.parameters().front().value.clone(), was = bias.clone();
  bias.fill_(std::numeric_limits<float>::quiet_NaN());
  trainer.StateChanged();
  std::string met;
  try {
    for (int i = 0; i < 40; ++i) trainer.Step();
  } catch (const TrainingDiverged& diverged) {
    met = diverged.what();
  }
  EXPECT_THAT(met, HasSubstr("a loss that is not a number (colour)"));
  EXPECT_EQ(trainer.state().n_skipped, Trainer::kMostSkipped);
  trainer.Evidence();
  EXPECT_TRUE(at::equal(trainer.state().field.parameters().front().value, before));
  bias.copy_(was);
  trainer.StateChanged();
  trainer.Step();
  trainer.Sync();
  trainer.CheckState();
  EXPECT_FALSE(at::equal(trainer.state().field.parameters().front().value, before));
}

TEST_F(GpuTraining, CheckLooksAtEveryStep) {
  TrainOptions options = options_;
  options.check = true;
  Trainer trainer(scene_, pack_, {}, BallPreset(60), options);
  trainer.Step();
  const c10::NoGradGuard no_grad;
  trainer.state().adam_v[1].fill_(std::numeric_limits<float>::infinity());
  trainer.StateChanged();
  EXPECT_THROW(
      {
        try {
          trainer.Step();
        } catch (const TrainingDiverged& diverged) {
          EXPECT_THAT(diverged.what(), HasSubstr("second moment in level 0 (16 nodes) of appearance_grid"));
          throw;
        }
      },
      TrainingDiverged);
}

// By the parameters' mean, as on the CPU.
TEST_F(GpuTraining, ShowsHeldOutViewsByItsMean) {
  Preset preset = BallPreset(60);
  preset.train.average_from = 0.2;
  preset.train.average_interval = 5;
  Trainer trainer(scene_, pack_, {}, preset, options_);
  while (!trainer.Done()) trainer.Step();
  trainer.Sync();
  const HeldOutViews held_out(scene_, pack_, 1);
  const double on_gpu =
      held_out.Psnr([&](const View& view, const Rays& rays) { return trainer.RenderMean(view, rays); });
  trainer.state().SwapAverage();
  EXPECT_NEAR(on_gpu, HeldOutPsnr(trainer), 0.1);
}

// Pictures by the GPU's kernels are the CPU's, whether all rays fit at once or not; what the tolerance leaves out stays
// within it.
TEST_F(GpuTraining, RendersWhatTheCpuRenders) {
  Trainer trainer(scene_, pack_, {}, BallPreset(100), {.seed = 3});
  while (!trainer.Done()) trainer.Step();
  const TrainState& state = trainer.state();
  for (const int64_t room : {4096, 200}) {
    const GpuTrainerFactory factory = [&](const GpuModel& model, const GpuScene& scene, int resolution,
                                          GpuTrainerOptions options) {
      options.precision = GpuPrecision::kFloat;
      options.room = {room, 4096, 4096};
      return GpuUnderTest()(model, scene, resolution, options);
    };
    const GpuRenderer renderer(factory, state.field, state.occupancy);
    RenderOptions options = PictureOptions(trainer.EvaluationOptions(), 16);
    const RenderedImage expected = RenderImage(state.field, state.occupancy, state.map, scene_.views[6], options);
    const RenderedImage found = renderer.Render(scene_.views[6], state.map, options);
    EXPECT_EQ(found.n_shaded, expected.n_shaded);
    const auto furthest = [](const std::vector<float>& a, const std::vector<float>& b) {
      float most = 0;
      for (size_t i = 0; i < a.size(); ++i) most = std::max(most, std::abs(a[i] - b[i]));
      return most;
    };
    EXPECT_LT(furthest(found.rgb, expected.rgb), 2e-5);
    EXPECT_LT(furthest(found.opacity, expected.opacity), 2e-5);
    EXPECT_LT(furthest(found.depth, expected.depth), 1e-3);
    EXPECT_LT(furthest(found.normal, expected.normal), 1e-3);
    options.colour_tolerance = kEightBitTolerance;
    const RenderedImage tolerant = renderer.Render(scene_.views[6], state.map, options);
    EXPECT_LT(tolerant.n_shaded, found.n_shaded);
    EXPECT_LT(furthest(tolerant.rgb, expected.rgb), 2 * kEightBitTolerance);
  }
}

// The GPU has room for a fraction of what the preset asks for: rays are halved until a step fits, and it learns.
TEST_F(GpuTraining, MakesDoWithLittleMemory) {
  Preset preset = BallPreset(120);
  preset.train.rays = preset.train.max_rays = 512;
  preset.train.target_shaded = 0;
  {
    Trainer trainer(scene_, pack_, {}, preset, options_);
    trainer.Step();
  }
  const size_t needed = MostGpuMemoryUsed();
  if (!LimitGpuMemory(needed / 2)) GTEST_SKIP() << "a GPU's memory cannot be limited";
  Trainer trainer(scene_, pack_, {}, preset, options_);
  const double before = HeldOutPsnr(trainer);
  while (!trainer.Done()) trainer.Step();
  trainer.Sync();
  EXPECT_GT(HeldOutPsnr(trainer), before + 6);
  EXPECT_LE(MostGpuMemoryUsed(), needed / 2);
}

TEST_F(GpuTraining, RefusesAnEncodingThatAGpuHasNot) {
  Preset preset = BallPreset(60);
  preset.field.directional_encoding = DirectionalEncoding::kIde;
  try {
    const Trainer trainer(scene_, pack_, {}, preset, options_);
    FAIL() << "was made";
  } catch (const Error& error) {
    EXPECT_THAT(error.what(), HasSubstr("directional encoding is ide"));
    EXPECT_THAT(error.what(), HasSubstr("--device cpu"));
  }
}

// Not even the model has room: said with what is missing and what to do.
TEST_F(GpuTraining, SaysWhatIsMissingWhereTheModelHasNoRoom) {
  if (!LimitGpuMemory(size_t{1} << 16)) GTEST_SKIP() << "a GPU's memory cannot be limited";
  try {
    const Trainer trainer(scene_, pack_, {}, BallPreset(60), options_);
    FAIL() << "found room";
  } catch (const Error& error) {
    EXPECT_EQ(error.code(), ExitCode::kResource);
    EXPECT_THAT(error.what(), HasSubstr("MiB are free; the model does not fit"));
    EXPECT_THAT(error.what(), HasSubstr("--preset"));
  }
}

}  // namespace
}  // namespace nrff
