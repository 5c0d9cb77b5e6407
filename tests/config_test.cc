// Presets, the changes that are made to them, and schedules.

#include "model/config.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "model/schedule.h"
#include "model/training.h"
#include "pipeline/error.h"

namespace nrff {
namespace {

using ::testing::HasSubstr;

TEST(Schedule, RunsFromItsFirstValuesToItsLast) {
  const TrainConfig config = MakePreset("small", false).train;
  EXPECT_EQ(StepStage(config, 0), 0);
  EXPECT_EQ(StepStage(config, 1), int(config.step_voxels.size()) - 1);
  EXPECT_NEAR(WeightThreshold(config, 0), config.weight_threshold_first, 1e-12);
  EXPECT_NEAR(WeightThreshold(config, 1), config.weight_threshold_last, 1e-12);
  EXPECT_NEAR(RateFactor(config, 0, 0), 1, 1e-12);
  EXPECT_NEAR(RateFactor(config, 1, 0), config.final_rate, 1e-12);
  EXPECT_DOUBLE_EQ(CurveMoment(kCurvePoints - 1), 1);
  for (int i = 1; i < kCurvePoints; ++i) EXPECT_GT(CurveMoment(i), CurveMoment(i - 1));
}

TEST(Presets, FewViewsLeaveOutFineLevelsAndKeepTheRatioOfThoseThatStay) {
  const Preset small = MakePreset("small", true);
  Preset few = small;
  EXPECT_FALSE(FitDepths(few, 3, /*unbounded=*/true).needed);
  EXPECT_EQ(few.train.depth_weight, 0);
  EXPECT_FALSE(FitLevelsToViews(few, "small", 9).needed);
  EXPECT_EQ(few.field.max_resolution, 64);
  EXPECT_EQ(few.field.levels, 5);  // 16 … 64 of the eight levels 16 … 256

  Preset many = small;
  EXPECT_FALSE(FitDepths(many, 50000, /*unbounded=*/false).needed) << "silhouettes do";
  EXPECT_TRUE(FitLevelsToViews(many, "small", 43).needed);
  EXPECT_EQ(many.field, small.field);

  Preset held = small;
  EXPECT_TRUE(FitDepths(held, 2000, /*unbounded=*/true).needed);
  EXPECT_TRUE(FitLevelsToViews(held, "small", 9).needed) << "sparse depths hold the surfaces";
  EXPECT_EQ(held.field, small.field);
}

TEST(Presets, PaperStaysAsPublished) {
  const Preset paper = MakePreset("paper", true);
  Preset fitted = paper;
  EXPECT_FALSE(FitDepths(fitted, 2000, /*unbounded=*/true).needed);
  EXPECT_TRUE(FitLevelsToViews(fitted, "paper", 9).needed);
  EXPECT_EQ(fitted.field, paper.field);
  EXPECT_EQ(fitted.train.depth_weight, 0);
}

TEST(Presets, ForcedDecisionsChangeTheModelAsTheySay) {
  const Preset small = MakePreset("small", true);
  Preset preset = small;
  EXPECT_FALSE(FitDepths(preset, 2000, true, false).needed);
  EXPECT_EQ(preset.train.depth_weight, 0);
  EXPECT_TRUE(FitDepths(preset, 2000, false, true).needed);
  EXPECT_GT(preset.train.depth_weight, 0);
  EXPECT_TRUE(FitLevelsToViews(preset, "small", 3, true).needed);
  EXPECT_EQ(preset.field, small.field);
  EXPECT_FALSE(FitLevelsToViews(preset, "small", 100, false).needed);
  EXPECT_EQ(preset.field.max_resolution, 128) << "an octave less";
  Preset paper = MakePreset("paper", true);
  EXPECT_TRUE(FitDepths(paper, 10, true, true).needed);
  EXPECT_GT(paper.train.depth_weight, 0);
  EXPECT_FALSE(FitLevelsToViews(paper, "paper", 9, false).needed);
  EXPECT_EQ(paper.field.max_resolution, 64);
  EXPECT_THROW(FitDepths(preset, 0, true, true), Error) << "there are none";
}

TEST(Presets, CamerasAreCorrectedFromTheirThresholdOnOrAsIsForced) {
  EXPECT_FALSE(needs::CameraCorrection({}, 0.8).needed);
  EXPECT_FALSE(needs::CameraCorrection(0.79, 0.8).needed);
  EXPECT_TRUE(needs::CameraCorrection(0.8, 0.8).needed);
  EXPECT_FALSE(needs::CameraCorrection(0.8, 2).needed) << "training was told otherwise";
  Preset paper = MakePreset("paper", false), small = MakePreset("small", true);
  FitCameras(paper);
  EXPECT_TRUE(paper.train.camera_moments.empty());
  FitCameras(paper, true);
  EXPECT_FALSE(paper.train.camera_moments.empty());
  EXPECT_EQ(paper.train.camera_least_px, 0);
  FitCameras(small);
  EXPECT_EQ(small.train.camera_least_px, needs::kVisibleDisplacement_px);
  FitCameras(small, false);
  EXPECT_TRUE(small.train.camera_moments.empty());
}

TEST(Presets, SingleValuesCanBeSetAndWhatCannotBeIsNamed) {
  Preset preset = MakePreset("small", true);
  ApplySettings("field.levels=10  train.step_voxels=[10,20] train.step_moments=[0.5] train.lazy_grids=false", preset);
  EXPECT_EQ(preset.field.levels, 10);
  EXPECT_EQ(preset.train.step_voxels, (std::vector{10, 20}));
  EXPECT_FALSE(preset.train.lazy_grids);
  const Preset before = preset;
  for (const auto& [setting, text] : std::vector<std::pair<std::string, std::string>>{
           {"levels=3", "field.KEY=VALUE"},
           {"field.level=3", "there is no field.level; there are"},
           {"field.levels=three", "another kind of value than the preset's 10"},
           {"field.levels=3.7", "another kind of value"},
           {"field.levels=1e30", "another kind of value"},
           {"field.levels=4294967300", "too large"},
           {"field.levels=0", "levels is 0, expected 1 to"},
           {"train.grid_rate=-1", "rates and epsilon must be positive"},
           {"train.depth_weight=-1", "must not be negative"},
           {"train.occupancy_resolution=100", "multiple of 8"},
           {"train.lazy_grids=1", "another kind of value than the preset's false"},
           {"train.step_voxels=[true,false]", "another kind of value"},
           {"train.step_voxels=[1,2,3]", "one entry more"}}) {
    SCOPED_TRACE(setting);
    Preset changed = before;
    try {
      ApplySettings(setting, changed);
      FAIL();
    } catch (const Error& error) {
      EXPECT_EQ(error.code(), ExitCode::kUsage);
      EXPECT_THAT(error.what(), HasSubstr(text));
      EXPECT_EQ(changed.field, before.field);
    }
  }
}

TEST(Presets, EachIsConsistentAndUnknownOnesAreNamed) {
  for (const char* name : kPresetNames) {
    for (const bool unbounded : {false, true}) {
      const Preset preset = MakePreset(name, unbounded);
      EXPECT_EQ(preset.train.step_voxels.size(), preset.train.step_moments.size() + 1) << name;
      EXPECT_EQ(FieldConfigFromJson(ToJson(preset.field), name), preset.field) << name;
    }
  }
  EXPECT_THROW(MakePreset("huge", false), Error);
}

TEST(DescribeTrainingTest, SaysWhatThePresetAndTheChangesMean) {
  TrainingRequest request;
  request.settings = "train.rays=77";
  const Json small = DescribeTraining(request);
  EXPECT_EQ(small["preset"], "small");
  EXPECT_EQ(small["device"], "cpu");
  EXPECT_EQ(small["steps"], MakePreset("small", true).train.steps);
  EXPECT_EQ(small["settings"]["unbounded"]["train"]["rays"], 77);
  EXPECT_EQ(small["settings"]["bounded"]["field"]["levels"], MakePreset("small", false).field.levels);
  request.budget_seconds = 60;
  EXPECT_TRUE(DescribeTraining(request)["steps"].is_null());
}

TEST(DescribeTrainingTest, RefusesWhatTrainingWouldRefuse) {
  TrainingRequest size, setting, device, finer;
  size.preset = "huge";
  setting.settings = "field.colour=3";
  device.device = "cuda";
  const auto code = [](const TrainingRequest& request) {
    try {
      DescribeTraining(request);
    } catch (const Error& error) {
      return error.code();
    }
    return ExitCode::kDone;
  };
  EXPECT_EQ(code(size), ExitCode::kUsage);
  EXPECT_EQ(code(setting), ExitCode::kUsage);
  EXPECT_EQ(code(device), ExitCode::kResource);
  finer.settings = "field.base_resolution=200";
  // Finer than the levels of bounded scenes, not of unbounded ones.
  const Json fine = DescribeTraining(finer);
  EXPECT_TRUE(fine["settings"]["bounded"].is_null());
  EXPECT_EQ(fine["settings"]["unbounded"]["field"]["base_resolution"], 200);
}

}  // namespace
}  // namespace nrff
