// nrff benchmark, with stages that stand in for the real ones.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>

#include "pipeline/json.h"
#include "pipeline/manifest.h"
#include "tests/driver_fixture.h"

namespace nrff {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

TEST_F(DriverTest, BenchmarkRunsEverySceneAndGoesOnFromWhatIsThere) {
  for (const char* scene : {"set/Barn", "set/mine"}) {
    MakeCapture(scene);
    WriteFileAtomically(root_ / scene / "intrinsics.txt", "1");
    fs::create_directories(root_ / scene / "pose");
  }
  const std::map<std::string, std::string> posed = {{"FAKE_POSED", "1"}};
  const std::vector<std::string> command = {"benchmark", "tanks-and-temples", Path("set"), "-w", Path("bench")};
  auto failing = posed;
  failing["FAKE_FAIL"] = "mine/train";
  const ProgramResult half = Nrff(command, failing);
  EXPECT_EQ(half.exit_code, 3);
  EXPECT_THAT(half.out, HasSubstr("| mine | failed: mine/train was told to fail"));
  Json table = ReadJson(root_ / "bench/benchmark.json");
  EXPECT_EQ(table["mean"]["n_scenes"], 1);
  Ran();

  EXPECT_EQ(Nrff(command, posed).exit_code, 0);
  EXPECT_THAT(Ran(), ElementsAre("train", "render", "eval"));
  table = ReadJson(root_ / "bench/benchmark.json");
  EXPECT_EQ(table["mean"]["psnr"], 21.5);
  EXPECT_EQ(table["scenes"].size(), 2);
  EXPECT_EQ(table["command"], "nrff benchmark tanks-and-temples DIR");
  EXPECT_EQ(RequireArtifact(root_ / "bench/Barn/render", "render").params.at("bit-depth"), "16");
  EXPECT_EQ(RequireArtifact(root_ / "bench/Barn/pose", "pose").params.at("max-image-size"), "1920");
  EXPECT_TRUE(fs::exists(root_ / "bench/benchmark.html"));

  // One scene gets a folder of its own, too; what is given replaces the data set's own size.
  const ProgramResult one = Nrff(
      {"benchmark", "tanks-and-temples", Path("set/mine"), "-w", Path("one"), "--quiet", "--max-image-size", "200"},
      posed);
  EXPECT_EQ(one.out + one.err, "");
  EXPECT_EQ(RequireArtifact(root_ / "one/mine/pose", "pose").params.at("max-image-size"), "200");
  EXPECT_THAT(Nrff({"benchmark", "llff", Path("set")}).err, HasSubstr("holds no scene of llff"));
  const ProgramResult dry =
      Nrff({"benchmark", "tanks-and-temples", Path("set"), "-w", Path("dry"), "--dry-run"}, posed);
  EXPECT_EQ(dry.exit_code, 0);
  EXPECT_FALSE(fs::exists(root_ / "dry"));
}

TEST_F(DriverTest, WorkPrecisionTrainsEveryBudgetAndSeedOnTheScenesOwnPoses) {
  const std::map<std::string, std::string> posed = {{"FAKE_POSED", "1"}};
  RunFox({"--steps", "7"}, posed);
  Ran();
  const std::vector<std::string> command = {"benchmark", "work-precision", Path("work"), "--budgets",
                                            "4s,2s,2s",  "--seeds",        "2"};
  const ProgramResult result = Nrff(command, posed);
  EXPECT_EQ(result.exit_code, 0) << result.err;
  EXPECT_THAT(result.out, HasSubstr("| 2.0 | small | 21.50 | 0.7500 | – |"));
  EXPECT_THAT(result.out, HasSubstr("reaches 20 dB: 2 s."));
  EXPECT_THAT(result.out, HasSubstr("| step | **1** | 0.100 |"));
  std::vector<std::string> ran = Ran();
  EXPECT_EQ(std::count(ran.begin(), ran.end(), "train"), 4);
  EXPECT_EQ(std::count(ran.begin(), ran.end(), "rendering"), 1);
  EXPECT_EQ(std::count(ran.begin(), ran.end(), "scoring"), 1);
  EXPECT_THAT(result.out, HasSubstr("| **8 × 6** | 30.50 | – | – | 2.5e-01 | – | – |"));
  EXPECT_EQ(std::count(ran.begin(), ran.end(), "ingest") + std::count(ran.begin(), ran.end(), "pose"), 0);
  const Json json = ReadJson(root_ / "work/work-precision/work_precision.json");
  EXPECT_EQ(json["training"]["bands"].size(), 2);
  EXPECT_EQ(json["training"]["bands"][1]["seconds"], Json({{"mean", 4}, {"least", 4}, {"most", 4}}));
  EXPECT_EQ(json["training"]["runs"][3]["workspace"], "4s-seed1");
  EXPECT_TRUE(fs::exists(root_ / "work/work-precision/work_precision.html"));

  // Nothing is done twice; another budget trains that alone.
  EXPECT_EQ(Nrff(command, posed).exit_code, 0);
  EXPECT_THAT(Ran(), IsEmpty());
  EXPECT_EQ(Nrff({"benchmark", "work-precision", Path("work"), "--budgets", "2s,8s", "--seeds", "1"}, posed).exit_code,
            0);
  ran = Ran();
  EXPECT_EQ(std::count(ran.begin(), ran.end(), "train"), 1);

  EXPECT_EQ(json["poses"]["reason"], "the photos do not lie in one folder of their own");

  EXPECT_EQ(Nrff({"benchmark", "work-precision", Path("fox")}, posed).exit_code, 3);
  EXPECT_EQ(Nrff({"benchmark", "work-precision", Path("work"), "--budgets", "soon"}, posed).exit_code, 2);
  EXPECT_EQ(Nrff({"benchmark", "work-precision", Path("work"), "--budgets", ","}, posed).exit_code, 2);
}

// Without poses of the capture's own, too: what was estimated once is not estimated again for every seed.
TEST_F(DriverTest, WorkPrecisionTakesEstimatedPosesAsTheyAre) {
  RunFox({"--until", "render"});
  Ran();
  const ProgramResult result =
      Nrff({"benchmark", "work-precision", Path("work"), "--budgets", "2s", "--seeds", "2"}, {{"FAKE_PAYLOAD", "new"}});
  EXPECT_EQ(result.exit_code, 0) << result.err;
  const std::vector<std::string> ran = Ran();
  EXPECT_EQ(std::count(ran.begin(), ran.end(), "train"), 2);
  EXPECT_EQ(std::count(ran.begin(), ran.end(), "sfm") + std::count(ran.begin(), ran.end(), "pose"), 0);
  EXPECT_THAT(result.out, HasSubstr("Not measured: the capture brings no poses"));
  EXPECT_EQ(Nrff({"benchmark", "work-precision", Path("work"), "--parts", "training", "--budgets", "2s"}).exit_code, 0);
}

TEST_F(DriverTest, WorkPrecisionTellsWhatIsMissingBeforeItTrains) {
  RunFox({"--until", "pose"});
  Ran();
  const ProgramResult result = Nrff({"benchmark", "work-precision", Path("work"), "--budgets", "2s"});
  EXPECT_EQ(result.exit_code, 3);
  EXPECT_THAT(result.err, HasSubstr("has no finished train yet"));
  EXPECT_THAT(Ran(), IsEmpty());
}

TEST_F(DriverTest, WorkPrecisionEstimatesPosesThatTheCaptureBringsFromItsPhotosAlone) {
  fs::create_directories(root_ / "fox/images");
  const std::map<std::string, std::string> posed = {{"FAKE_POSED", "1"}};
  RunFox({}, posed);
  Ran();
  const std::vector<std::string> command = {"benchmark", "work-precision", Path("work"), "--parts", "poses"};
  auto failing = posed;
  failing["FAKE_FAIL"] = "1000px-4096-exhaustive/sfm";
  const ProgramResult result = Nrff(command, failing);
  EXPECT_EQ(result.exit_code, 0) << result.err;
  const std::vector<std::string> ran = Ran();
  EXPECT_EQ(std::count(ran.begin(), ran.end(), "sfm"), 7);
  EXPECT_EQ(std::count(ran.begin(), ran.end(), "train"), 0);
  EXPECT_THAT(result.out, HasSubstr("| **1000** | **2048** | exhaustive |"));
  EXPECT_THAT(result.out, HasSubstr("| 1.000 | 0.500 | 0.750 |"));
  EXPECT_THAT(result.out, HasSubstr("1000px-4096-exhaustive/sfm was told to fail"));
  const Json poses = ReadJson(root_ / "work/work-precision/work_precision.json")["poses"];
  EXPECT_EQ(poses["points"].size(), 7);
  EXPECT_EQ(RequireArtifact(root_ / "work/work-precision/poses/500px-2048-exhaustive/sfm", "sfm").params,
            (Params{{"matching", "exhaustive"}, {"sfm-features", "2048"}, {"sfm-image-size", "500"}}));
}

TEST_F(DriverTest, AblationTrainsEverySettingOfThePaperForEqualSteps) {
  const std::map<std::string, std::string> posed = {{"FAKE_POSED", "1"}};
  RunFox({"--budget", "9s", "--set", "train.rays=512", "--directional", "ree"}, posed);
  Ran();
  const std::vector<std::string> command = {"benchmark", "ablation", Path("work"), "--steps", "70", "--seeds", "2"};
  const ProgramResult result = Nrff(command, posed);
  EXPECT_EQ(result.exit_code, 0) << result.err;
  EXPECT_THAT(result.out, HasSubstr("| vector-matrix + PE | 21.50 | 0.7500 | – | 1000 | – | – | 34.10 |"));
  EXPECT_THAT(result.out, HasSubstr("| **MTD + REE** |"));
  EXPECT_THAT(result.out, HasSubstr("| **4 levels** |"));
  const std::vector<std::string> ran = Ran();
  // Six models and five numbers of levels, of which the scene's own is one of the models.
  EXPECT_EQ(std::count(ran.begin(), ran.end(), "train"), 2 * 10);
  EXPECT_EQ(std::count(ran.begin(), ran.end(), "ingest") + std::count(ran.begin(), ran.end(), "pose"), 0);
  const Json json = ReadJson(root_ / "work/ablation/ablation.json");
  EXPECT_EQ(json["steps"], 70);
  EXPECT_EQ(json["groups"][0]["rows"].size(), 6);
  EXPECT_EQ(json["groups"][1]["rows"].size(), 5);
  for (const Json& group : json["groups"]) {
    for (const Json& row : group["rows"]) {
      EXPECT_EQ(row["runs"].size(), 2);
      EXPECT_EQ(row["runs"][1]["seed"], 1);
      EXPECT_EQ(row["runs"][0]["steps"], 70);
    }
  }
  const Params params = RequireArtifact(root_ / "work/ablation/vm-pe-seed1/train", "train").params;
  EXPECT_THAT(params.at("set"), HasSubstr("train.rays=512 field.levels=1 field.base_resolution=64"));
  EXPECT_THAT(params.at("set"), HasSubstr("field.directional_encoding=\"pe\""));
  EXPECT_FALSE(params.contains("directional") || params.contains("budget"));
  EXPECT_TRUE(fs::exists(root_ / "work/ablation/ablation.html"));

  // Nothing is done twice; the steps are those of the scene's model where none are given.
  EXPECT_EQ(Nrff(command, posed).exit_code, 0);
  EXPECT_THAT(Ran(), IsEmpty());
  EXPECT_EQ(Nrff({"benchmark", "ablation", Path("work"), "--quiet"}, posed).exit_code, 0);
  EXPECT_EQ(ReadJson(root_ / "work/ablation/ablation.json")["steps"], 8000);
}

TEST_F(DriverTest, AblationNeedsATrainedModel) {
  RunFox({"--until", "pose"});
  const ProgramResult result = Nrff({"benchmark", "ablation", Path("work")});
  EXPECT_EQ(result.exit_code, 3);
  EXPECT_THAT(result.err, HasSubstr("has no finished train yet"));
}

}  // namespace
}  // namespace nrff
