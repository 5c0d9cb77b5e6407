// Laws of training: it improves, it can be stopped and go on without a trace, and what is damaged is not trusted.

#include <ATen/ATen.h>
#include <c10/core/GradMode.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <fstream>
#include <map>
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
#include "tests/ball_scene.h"
#include "tests/temporary_directory.h"

namespace nrff {
namespace {

using ::testing::HasSubstr;
using torch::Tensor;

TEST_F(TrainTest, ImprovesOnViewsItHasNotSeen) {
  Trainer trainer(scene_, pack_, {}, BallPreset(300), {});
  const double before = HeldOutPsnr(trainer);
  while (!trainer.Done()) trainer.Step();
  const double after = HeldOutPsnr(trainer);
  EXPECT_GT(after, before + 8);
  EXPECT_GT(after, 20);
  EXPECT_EQ(trainer.state().n_skipped, 0);
  EXPECT_LT(trainer.state().occupancy.OccupiedFraction(), 0.7);
}

TEST_F(TrainTest, StoppedAndResumedGivesTheSameBitsAsNeverStopped) {
  Preset preset = BallPreset(60);  // the step changes, occupancy is updated and the box shrinks on the way
  preset.train.depth_weight = 0.1;
  preset.train.average_from = 0.6;
  preset.train.average_interval = 5;
  preset.train.camera_moments = {0.3, 0.5};
  preset.train.camera_least_px = 0;
  const std::vector<SparseDepth> depths = BallDepths(scene_);
  Trainer whole(scene_, pack_, depths, preset, {.seed = 3});
  while (!whole.Done()) whole.Step();
  EXPECT_GT(whole.state().shrink_moments_done, 0);
  EXPECT_GT(whole.state().n_averaged, 2);
  EXPECT_EQ(whole.state().camera_moments_done, 2);
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
    second.StateChanged();
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
  Preset preset = BallPreset(60);
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
  Trainer a(scene_, pack_, {}, BallPreset(2), {.seed = 1}), b(scene_, pack_, {}, BallPreset(2), {.seed = 2});
  EXPECT_NE(ModelBytes(a), ModelBytes(b));
}

TEST_F(TrainTest, HeldOutPixelsChangeNothing) {
  const TemporaryDirectory other;
  const Scene scene = WriteBallScene(other.path());
  const uint64_t begin = scene.views[6].pack_offset;
  std::fstream pack(other.path() / kPackFile, std::ios::in | std::ios::out | std::ios::binary);
  pack.seekp(std::streamoff(begin));
  pack << std::string(2 * kBallViewSize * kBallViewSize * 4, '\x55');
  pack.close();
  const ImagePack other_pack(other.path());
  Trainer a(scene_, pack_, {}, BallPreset(20), {}), b(scene, other_pack, {}, BallPreset(20), {});
  while (!a.Done()) a.Step();
  while (!b.Done()) b.Step();
  EXPECT_EQ(ModelBytes(a), ModelBytes(b));
}

TEST_F(TrainTest, ModelReadBackShowsTheSame) {
  Trainer trainer(scene_, pack_, {}, BallPreset(40), {});
  while (!trainer.Done()) trainer.Step();
  const TemporaryDirectory out;
  SaveModel(out.path(), trainer.state(), trainer.EvaluationOptions());
  const std::unique_ptr<LoadedModel> model = LoadModel(out.path());
  EXPECT_EQ(model->field->config(), trainer.preset().field);
  const double read_back = HeldOutViews(scene_, pack_, 1).Psnr([&](const View& /*view*/, const Rays& rays) {
    return RenderRays(*model->field, model->occupancy, model->map, rays, model->options).rgb;
  });
  EXPECT_EQ(read_back, HeldOutPsnr(trainer));
}

TEST_F(TrainTest, NothingThatIsNotFiniteIsWritten) {
  Trainer trainer(scene_, pack_, {}, BallPreset(10), {});
  trainer.Step();
  const TemporaryDirectory out;
  SaveCheckpoint(out.path(), trainer.state(), "");
  const std::string before = ReadFile(out.path() / kCheckpointFile);
  trainer.state().adam_v[3].fill_(INFINITY);
  EXPECT_THROW(SaveCheckpoint(out.path(), trainer.state(), ""), Error);
  EXPECT_EQ(ReadFile(out.path() / kCheckpointFile), before);
}

TEST_F(TrainTest, StepsThatAreNotFiniteAreSkippedAndManyInARowEndWithTheEvidence) {
  Trainer trainer(scene_, pack_, {}, BallPreset(100), {});
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
    Trainer trainer(scene_, pack_, {}, BallPreset(10), {.check = check});
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
  EXPECT_THROW(Trainer(scene_, pack_, {}, BallPreset(10), {}), Error);
}

TEST_F(TrainTest, ACameraThatIsNotFiniteIsRefusedByName) {
  scene_.views[2].scene_from_camera[3] = NAN;
  try {
    const Trainer trainer(scene_, pack_, {}, BallPreset(10), {});
    FAIL() << "was accepted";
  } catch (const Error& error) {
    EXPECT_EQ(error.code(), ExitCode::kInput);
    EXPECT_THAT(error.what(), HasSubstr("000002.png"));
  }
}

TEST_F(TrainTest, ADamagedOrForeignCheckpointIsRefused) {
  Trainer trainer(scene_, pack_, {}, BallPreset(10), {});
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
  Trainer one(scene_, pack_, {}, BallPreset(1'000'000), {.budget_seconds = 1e-6});
  EXPECT_FALSE(one.Done());
  one.Step();
  EXPECT_TRUE(one.Done());
  Trainer trainer(scene_, pack_, {}, BallPreset(1'000'000), {.budget_seconds = 10});
  trainer.Step();
  const double step = trainer.state().seconds;
  trainer.state().seconds = 10 - 0.6 * step;
  EXPECT_FALSE(trainer.Done());
  trainer.state().seconds = 10 - 0.4 * step;
  EXPECT_TRUE(trainer.Done());
}

TEST_F(TrainTest, ABudgetOfSecondsEndsTheTraining) {
  Trainer trainer(scene_, pack_, {}, BallPreset(1'000'000), {.budget_seconds = 0.5});
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

// Training views 0.7 and 1.43 times as bright by turns; held-out views as they are.
TEST_F(TrainTest, TheFieldKeepsTheMeanExposureAndViewsTheirOwn) {
  const TemporaryDirectory other;
  Scene scene = scene_;
  std::string bytes = ReadFile(directory_.path() / kPackFile);
  for (const int v : scene.ViewsOf(Split::kTrain)) {
    const double gain = v % 2 == 0 ? 0.7 : 1 / 0.7;
    for (uint64_t i = 0; i < scene.views[v].PixelBytes(); ++i) {
      char& value = bytes[scene.views[v].pack_offset + i];
      if (i % 4 != 3) value = char(uint8_t(std::min(255., std::lround(0.7 * gain * uint8_t(value)) + 0.)));
    }
  }
  for (const int v : scene.ViewsOf(Split::kTest)) {
    for (uint64_t i = 0; i < scene.views[v].PixelBytes(); ++i) {
      char& value = bytes[scene.views[v].pack_offset + i];
      if (i % 4 != 3) value = char(uint8_t(std::lround(0.7 * uint8_t(value))));
    }
  }
  WriteFileAtomically(other.path() / kPackFile, bytes);
  const ImagePack pack(other.path());
  const auto held_out_psnr = [&](bool corrected, bool gains_given) {
    for (View& view : scene.views) view.colour_gain = {1, 1, 1};
    for (const int v : scene.ViewsOf(Split::kTrain)) {
      if (gains_given) scene.views[v].colour_gain.fill(v % 2 == 0 ? 0.7 : 1 / 0.7);
    }
    Preset preset = BallPreset(300);
    preset.field.corrected_views = corrected ? 6 : 0;
    Trainer trainer(scene, pack, {}, preset, {});
    while (!trainer.Done()) trainer.Step();
    return HeldOutViews(scene, pack, 1).Psnr([&](const View& view, const Rays& rays) {
      return trainer.RenderMean(view, rays);
    });
  };
  const double plain = held_out_psnr(false, false), learnt = held_out_psnr(true, false),
               given = held_out_psnr(true, true);
  EXPECT_GT(learnt, plain + 1);
  EXPECT_GT(given, plain + 1);
}

// What does not count is drawn never, all else alike.
TEST_F(TrainTest, PixelsThatDoNotCountAreNotLearntFrom) {
  const TemporaryDirectory other;
  Scene scene = scene_;
  std::string bytes = ReadFile(directory_.path() / kPackFile);
  View& view = scene.views[2];
  view.masked = true;
  const auto counts = [](int64_t pixel) { return pixel % 7 != 0 && pixel % kBallViewSize > 3; };
  constexpr int64_t kPixels = kBallViewSize * kBallViewSize;
  for (int64_t i = 0; i < kPixels; ++i) bytes[view.pack_offset + 4 * i + 3] = char(counts(i) ? 255 : 254);
  WriteFileAtomically(other.path() / kPackFile, bytes);
  const ImagePack pack(other.path());
  const PixelSource source({scene.views[1], view}, pack, 1);
  const auto n_counting = int64_t(source.pixels_before()[2] - source.pixels_before()[1]);
  int64_t expected = 0;
  for (int64_t i = 0; i < kPixels; ++i) expected += counts(i);
  EXPECT_EQ(n_counting, expected);

  constexpr int64_t kRays = 200000;
  const PixelSource::Batch batch = source.Draw(kRays, 3, 0);
  // A ray's pixel, found again by the ray through it.
  std::vector<int64_t> drawn(kPixels);
  int64_t n_masked = 0;
  std::map<std::array<float, 3>, int64_t> pixel_of;
  for (int64_t i = 0; i < kPixels; ++i) {
    const auto at =
        source.At(torch::tensor({1, int(i % kBallViewSize), int(i / kBallViewSize)}, torch::kInt).view({1, 3}));
    const auto* d = at.rays.directions.const_data_ptr<float>();
    pixel_of[{d[0], d[1], d[2]}] = i;
  }
  for (int64_t r = 0; r < kRays; ++r) {
    if (batch.view[r].item<int>() != 1) continue;
    ++n_masked;
    const auto* d = batch.rays.directions.const_data_ptr<float>() + 3 * r;
    ++drawn.at(size_t(pixel_of.at({d[0], d[1], d[2]})));
  }
  EXPECT_NEAR(double(n_masked) / kRays, double(expected) / double(expected + kPixels), 0.005);
  const double mean = double(n_masked) / double(expected);
  for (int64_t i = 0; i < kPixels; ++i) {
    if (counts(i)) {
      ASSERT_NEAR(double(drawn[size_t(i)]), mean, 6 * std::sqrt(mean)) << i;
    } else {
      ASSERT_EQ(drawn[size_t(i)], 0) << i;
    }
  }
}

TEST_F(TrainTest, SparseDepthsBringTheSurfaceToWhereTheyAre) {
  const std::vector<SparseDepth> depths = BallDepths(scene_);
  const DepthSource source(scene_, depths);
  const auto missed_light = [&](double weight) {
    Preset preset = BallPreset(150);
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
