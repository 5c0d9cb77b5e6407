// Laws of the training stage as a whole: what it decides, writes and refuses, and how it comes through faults.

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <fstream>

#include "model/safetensors.h"
#include "model/training.h"
#include "pipeline/error.h"
#include "pipeline/extension.h"
#include "tests/ball_scene.h"

namespace nrff {
namespace {

using ::testing::HasSubstr;

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
  request.exposure_correction = true;
  request.camera_correction = true;
  RunTraining(request, {});
  const Manifest manifest = RequireArtifact(request.out, "train");
  const Json &facts = manifest.facts, &settings = facts.at("settings");
  EXPECT_EQ(settings.at("train").at("depth_rays"), 16);
  EXPECT_GT(settings.at("train").at("depth_weight"), 0);
  EXPECT_EQ(settings.at("field").at("max_resolution"), 32) << "an octave below tiny's 64";
  EXPECT_EQ(settings.at("field").at("levels"), 2);
  EXPECT_EQ(settings.at("field").at("corrected_views"), 6);
  for (const Decision& decision : manifest.decisions) {
    if (decision.feature == "cuda") continue;
    EXPECT_EQ(decision.reason, "forced by an option") << decision.feature;
  }
  const auto model = LoadModel(request.out);
  EXPECT_EQ(model->cameras.poses.size(), 6u);
  const Json cameras = ReadJson(request.out / "cameras.json").at("views");
  EXPECT_EQ(cameras.size(), 8u);
  EXPECT_EQ(cameras[0].at("fx"), model->cameras.Corrected(LoadScene(request.scene_dir).views[0]).fx);
  EXPECT_GE(facts.at("camera_displacement_px").at("largest"), facts.at("camera_displacement_px").at("median"));
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

// A training on four of the six views becomes the base of one on all.
class ExtendedTraining : public TrainStage {
 protected:
  ExtendedTraining() {
    request.exposure_correction = true;
    request.camera_correction = true;
    request.settings = "train.correction_rate=0.05";
    Scene fewer = scene_;
    std::erase_if(fewer.views, [&](const View& view) { return IsAdded(view); });
    WritePose(fewer);
    RunTraining(request, {});
    std::filesystem::rename(request.out, base_);
    WritePose(scene_);
    request.base = base_;
  }
  bool IsAdded(const View& view) const {
    const std::vector<int> training = scene_.ViewsOf(Split::kTrain);
    return view.id == scene_.views[size_t(training[1])].id || view.id == scene_.views[size_t(training[4])].id;
  }
  void WritePose(const Scene& scene) {
    ArtifactWriter artifact("pose", request.scene_dir, {}, {});
    std::filesystem::copy_file(directory_.path() / kPackFile, artifact.dir() / kPackFile);
    SaveScene(scene, artifact.dir());
    SaveSparseDepths({}, artifact.dir());
    for (const char* output : {kSceneFile, kPackFile, kDepthFile}) artifact.AddOutput(output);
    artifact.Commit();
  }
  std::vector<float> Values(const std::filesystem::path& dir, const std::string& parameter) const {
    return SafetensorsFile(dir / kModelFile).Values<float>("parameter/" + parameter);
  }
  Decision TrainingDecision() const {
    for (const Decision& decision : RequireArtifact(request.out, "train").decisions) {
      if (decision.feature == "training_anew") return decision;
    }
    ADD_FAILURE() << "nothing was decided";
    return {};
  }

  const std::filesystem::path base_ = directory_.path() / "base";
};

TEST_F(ExtendedTraining, GoesOnFromTheMeanOfTheBaseForAShareOfTheSteps) {
  request.settings = "train.network_rate=1e-12 train.grid_rate=1e-12 train.correction_rate=1e-12";  // stays there
  RunTraining(request, {});
  const Json facts = RequireArtifact(request.out, "train").facts;
  EXPECT_EQ(facts.at("extended").at("n_views_added"), 2);
  EXPECT_EQ(facts.at("extended").at("steps_before"), 12);
  EXPECT_EQ(facts.at("steps"), 4);
  EXPECT_FALSE(TrainingDecision().needed);
  EXPECT_FALSE(facts.at("settings").contains("views"));
  for (const char* parameter : {"appearance_grid", "density_grid", "spatial_mlp.0.weight"}) {
    const std::vector<float> before = Values(base_, parameter), after = Values(request.out, parameter);
    ASSERT_EQ(before.size(), after.size());
    for (size_t i = 0; i < before.size(); ++i) ASSERT_NEAR(before[i], after[i], 1e-6) << parameter;
  }
  // Corrections go to the views that had them; added ones start at their gain.
  const std::vector<float> before = Values(base_, "colour_corrections"),
                           after = Values(request.out, "colour_corrections");
  ASSERT_EQ(before.size(), 4 * 12u);
  ASSERT_EQ(after.size(), 6 * 12u);
  size_t row = 0;
  for (size_t i = 0; i < 6; ++i) {
    const View& view = scene_.views[size_t(scene_.ViewsOf(Split::kTrain)[i])];
    for (size_t k = 0; k < 12; ++k) ASSERT_NEAR(after[12 * i + k], IsAdded(view) ? 0 : before[12 * row + k], 1e-6) << i;
    row += IsAdded(view) ? 0 : 1;
  }
  EXPECT_GT(*std::max_element(before.begin(), before.end()), 1e-3) << "the base learnt none";
  EXPECT_EQ(RequireArtifact(request.out, "train").inputs.back().hash, HashTree(base_));
  // Cameras of added views are looked at, too.
  const CameraCorrections cameras = LoadModel(request.out)->cameras;
  EXPECT_EQ(LoadModel(base_)->cameras.poses.size(), 4u);
  ASSERT_EQ(cameras.poses.size(), 6u);
  for (const PoseCorrection& pose : cameras.poses)
    EXPECT_NE(pose.turn, Vec3{}) << pose.view << " was not looked at";
}

TEST_F(ExtendedTraining, StartsAnewInAnotherFrame) {
  Scene moved = scene_;
  moved.scene_from_world[3] += 1;
  WritePose(moved);
  RunTraining(request, {});
  EXPECT_TRUE(TrainingDecision().needed);
  EXPECT_THAT(TrainingDecision().reason, HasSubstr("another frame"));
  EXPECT_EQ(RequireArtifact(request.out, "train").facts.at("steps"), 12);
  EXPECT_TRUE(RequireArtifact(request.out, "train").facts.at("extended").is_null());
}

TEST_F(ExtendedTraining, StartsAnewWithAnotherField) {
  request.settings = "field.levels=3";
  RunTraining(request, {});
  EXPECT_THAT(TrainingDecision().reason, HasSubstr("field.levels is 3, it was "));
  EXPECT_EQ(RequireArtifact(request.out, "train").facts.at("steps"), 12);
}

TEST_F(ExtendedTraining, ThatIsStoppedGoesOnAndDoesNotStartFromTheBaseAgain) {
  RunTraining(request, {});
  const std::string checkpoint = ReadFile(request.out / kCheckpointFile);
  {
    const ArtifactWriter interrupted(
        "train", request.out, {},
        {ArtifactInput(request.scene_dir, RequireArtifact(request.scene_dir, "pose")), BaseInput(base_)},
        ArtifactWriter::kKeepPartial);
    interrupted.SaveSeconds();
    WriteFileAtomically(interrupted.dir() / kCheckpointFile, checkpoint);
  }
  RunTraining(request, {});
  EXPECT_EQ(RequireArtifact(request.out, "train").facts.at("resumed"), 1);
  EXPECT_EQ(RequireArtifact(request.out, "train").facts.at("steps"), 4);
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

}  // namespace
}  // namespace nrff
