// The driver with stages that stand in for the real ones.
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <unistd.h>

#include <chrono>
#include <fstream>
#include <iterator>
#include <sstream>
#include <thread>

#include "pipeline/branches.h"
#include "pipeline/commands.h"
#include "pipeline/disk.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"
#include "pipeline/local_executor.h"
#include "pipeline/manifest.h"
#include "pipeline/progress_view.h"
#include "pipeline/stages.h"
#include "pipeline/workspace.h"
#include "tests/driver_fixture.h"

namespace nrff {
namespace {

using ::testing::AllOf;
using ::testing::Contains;
using ::testing::ElementsAre;
using ::testing::Field;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using ::testing::Not;

TEST_F(DriverTest, RunsEveryStageOnceAndReusesAllOfThemAfterwards) {
  const ProgramResult first = RunFox();
  EXPECT_EQ(first.exit_code, 0) << first.err;
  EXPECT_THAT(Ran(), ElementsAre("ingest", "sfm", "pose", "train", "render", "eval"));
  EXPECT_TRUE(fs::exists(root_ / "work/report/report.html"));
  EXPECT_THAT(first.out, HasSubstr("work/report/report.html"));
  EXPECT_THAT(first.err, HasSubstr("left out: undistortion — largest displacement 0.03 px"));
  EXPECT_THAT(first.err, HasSubstr("train: info: halfway through"));
  const ProgramResult second = RunFox();
  EXPECT_EQ(second.exit_code, 0) << second.err;
  EXPECT_THAT(Ran(), IsEmpty());
  EXPECT_THAT(second.err, HasSubstr("report: reused"));
}

TEST_F(DriverTest, OptionGoesToItsStageAndMakesThatAndWhatFollowsStale) {
  RunFox({"--steps", "10"});
  Ran();
  EXPECT_EQ(RunFox({"--preset", "tiny", "--budget", "1m"}).exit_code, 0);
  EXPECT_THAT(Ran(), ElementsAre("train", "render", "eval"));
  const Params expected = {{"preset", "tiny"}, {"budget", "60s"}};
  EXPECT_EQ(ReadManifest(root_ / "work/train")->params, expected);
  RunFox({"--preset", "tiny", "--budget", "60s", "--threads", "1"});
  EXPECT_THAT(Ran(), IsEmpty());
  EXPECT_EQ(RunFox({"--steps", "20", "--budget", "1m"}).exit_code, 2);
  EXPECT_EQ(RunFox({"--budget", ""}).exit_code, 2);
}

TEST_F(DriverTest, ForcedDecisionsGoToTheStagesThatMakeThem) {
  RunFox();
  Ran();
  const ProgramResult forced =
      RunFox({"--need", "undistortion", "--leave-out", "sparse_depth", "--leave-out", "exhaustive_matching"});
  EXPECT_EQ(forced.exit_code, 0) << forced.err;
  EXPECT_EQ(ReadManifest(root_ / "work/sfm")->params, (Params{{"matching", "selective"}}));
  EXPECT_EQ(ReadManifest(root_ / "work/pose")->params, (Params{{"undistortion", "on"}}));
  EXPECT_EQ(ReadManifest(root_ / "work/train")->params, (Params{{"sparse-depth", "off"}}));
  std::vector<std::string> all;
  for (const Forceable& forceable : Forceables()) {
    all.insert(all.end(), {"--need", forceable.feature});
    EXPECT_THAT(kFeaturesHelp, HasSubstr(std::string(" ") + forceable.feature));
  }
  EXPECT_EQ(RunFox(all).exit_code, 0);
  for (const Forceable& forceable : Forceables()) {
    EXPECT_THAT(ReadManifest(root_ / "work" / forceable.stage)->params,
                Contains(std::pair<const std::string, std::string>(forceable.option, forceable.needed)));
  }
  const ProgramResult before = Nrff({"plan", "--need", "contraction", "--leave-out", "undistortion", Path("fox")});
  EXPECT_EQ(before.exit_code, 0) << before.err;
  const ProgramResult both = RunFox({"--need", "contraction", "--leave-out", "contraction"});
  EXPECT_EQ(both.exit_code, 2);
  EXPECT_THAT(both.err, HasSubstr("--need and --leave-out both name contraction"));
  for (const char* malformed : {"", " ", "levels=3", "field.levels", "field.=3", "field.levels="}) {
    EXPECT_EQ(RunFox({"--set", malformed}).exit_code, 2) << malformed;
  }
  const ProgramResult unknown = RunFox({"--leave-out", "training"});
  EXPECT_EQ(unknown.exit_code, 2);
  EXPECT_THAT(unknown.err, HasSubstr("nothing that can be forced"));
}

TEST_F(DriverTest, AnLpipsNetworkThatComesOrChangesMakesTheScoresStaleAlone) {
  RunFox();
  Ran();
  const fs::path network = root_ / "network.onnx";
  WriteFileAtomically(network, "one");
  const std::vector<std::string> with_network = {"--lpips", network.string()};
  EXPECT_EQ(RunFox(with_network).exit_code, 0);
  EXPECT_THAT(Ran(), ElementsAre("eval"));
  RunFox(with_network);
  EXPECT_THAT(Ran(), IsEmpty());
  WriteFileAtomically(network, "other");
  RunFox(with_network);
  EXPECT_THAT(Ran(), ElementsAre("eval"));
  RunFox();
  EXPECT_THAT(Ran(), ElementsAre("eval"));

  fs::create_directories(root_ / "data/nrff");
  WriteFileAtomically(root_ / "data/nrff/lpips_vgg.onnx", "found");
  const std::map<std::string, std::string> place = {{"XDG_DATA_HOME", (root_ / "data").string()}};
  RunFox({"--lpips", "none"}, place);
  EXPECT_THAT(Ran(), IsEmpty());
  RunFox({}, place);
  EXPECT_THAT(Ran(), ElementsAre("eval"));
  EXPECT_THAT(ReadManifest(root_ / "work/eval")->params.at("lpips"), HasSubstr("lpips_vgg.onnx ("));
  EXPECT_NE(RunFox({"--lpips", (root_ / "nowhere").string()}).exit_code, 0);
}

TEST_F(DriverTest, WorkspaceStandsForItsCaptureAndLastOptions) {
  RunFox({"--steps", "10"});
  Ran();
  EXPECT_EQ(Nrff({"run", Path("work")}).exit_code, 0);
  EXPECT_THAT(Ran(), IsEmpty());
  Nrff({"run", Path("work"), "--steps", "11"});
  EXPECT_THAT(Ran(), ElementsAre("train", "render", "eval"));
  Nrff({"run", Path("work"), "--budget", "1m"});
  EXPECT_EQ(ReadManifest(root_ / "work/train")->params, (Params{{"budget", "60s"}}));
}

TEST_F(DriverTest, OptionThatThisVersionDoesNotHaveIsForgottenWithAWarning) {
  RunFox();
  Workspace(Path("work")).WriteMarker({root_ / "fox", {{"colour", "red"}, {"steps", "10"}}});
  const ProgramResult result = Nrff({"run", Path("work")});
  EXPECT_EQ(result.exit_code, 0);
  EXPECT_THAT(result.err, HasSubstr("remembers --colour red, which this version does not have"));
  EXPECT_EQ(Workspace(Path("work")).ReadMarker().options, (Params{{"steps", "10"}}));
}

TEST_F(DriverTest, FromUntilAndForceChooseTheStages) {
  RunFox({"--until", "pose"});
  EXPECT_THAT(Ran(), ElementsAre("ingest", "sfm", "pose"));
  RunFox({"--from", "sfm", "--until", "pose"});
  EXPECT_THAT(Ran(), ElementsAre("sfm", "pose"));
  RunFox({"--force", "--until", "sfm"});
  EXPECT_THAT(Ran(), ElementsAre("ingest", "sfm"));
  EXPECT_EQ(RunFox({"--from", "eval", "--until", "sfm"}).exit_code, 2);
  EXPECT_EQ(RunFox({"--until", "nonsense"}).exit_code, 2);
}

TEST_F(DriverTest, ChangedPhotoRunsWhatDependsOnIt) {
  RunFox();
  Ran();
  WriteFileAtomically(root_ / "fox/photo.jpg", "another");
  const ProgramResult result = RunFox();
  EXPECT_THAT(result.err, HasSubstr("ingest: runs, since it was made before files in the capture changed"));
  EXPECT_THAT(Ran(), ElementsAre("ingest", "sfm", "pose", "train", "render", "eval"));
}

class ExtendedRun : public DriverTest {
 protected:
  ExtendedRun() {
    RunFox();
    Ran();
  }
  void AddPhoto(const std::string& name) { WriteFileAtomically(root_ / "fox" / name, name); }
};

TEST_F(ExtendedRun, TakesOverWhatWasMadeOfThePhotosThatWereThere) {
  AddPhoto("added.jpg");
  const std::string text = "1 photos were added to 1: their hold-out, features, matches, poses, frame and model";
  const std::string before = HashTree(root_ / "work");
  EXPECT_THAT(Nrff({"plan", Path("fox"), "--workspace", Path("work")}).out,
              AllOf(HasSubstr(text), HasSubstr("takes the added views' share")));
  EXPECT_EQ(HashTree(root_ / "work"), before);

  const std::string model = HashFile(root_ / "work/train/checkpoint.safetensors");
  const ProgramResult extended = RunFox();
  EXPECT_EQ(extended.exit_code, 0) << extended.err;
  EXPECT_THAT(extended.err, HasSubstr("info: work: " + text));
  EXPECT_THAT(Ran(),
              ElementsAre("ingest", "ingest+", "sfm", "sfm+", "pose", "pose+", "train", "train+", "render", "eval"));
  EXPECT_EQ(HashFile(root_ / "work/base/train/checkpoint.safetensors"), model);
  EXPECT_THAT(ReadManifest(root_ / "work/train")->inputs,
              Contains(Field(&HashedPath::hash, HashTree(root_ / "work/base/train"))));
  // What there is now is fresh, and stays so wherever the workspace is moved.
  EXPECT_EQ(RunFox().exit_code, 0);
  EXPECT_THAT(Ran(), IsEmpty());
  EXPECT_THAT(Nrff({"status", Path("work")}).out, Not(HasSubstr("stale")));
  fs::rename(root_ / "work", root_ / "moved");
  EXPECT_EQ(Nrff({"run", Path("moved")}).exit_code, 0);
  EXPECT_THAT(Ran(), IsEmpty());
}

TEST_F(ExtendedRun, DependsOnWhatItExtends) {
  AddPhoto("added.jpg");
  RunFox();
  Ran();
  WriteFileAtomically(root_ / "work/base/sfm/mapping/database.db", "another");
  EXPECT_THAT(Nrff({"status", Path("work")}).out, HasSubstr("does not extend what there was of fewer photos"));
  RunFox();
  EXPECT_THAT(Ran(), ElementsAre("sfm", "sfm+", "pose", "pose+", "train", "train+", "render", "eval"));
}

TEST_F(ExtendedRun, IsExtendedAgainFromWhatItBecame) {
  AddPhoto("added.jpg");
  RunFox();
  const std::string second = ReadFile(root_ / "work/train/manifest.json");
  AddPhoto("later.jpg");
  EXPECT_THAT(RunFox().err, HasSubstr("1 photos were added to 2"));
  EXPECT_EQ(ReadFile(root_ / "work/base/train/manifest.json"), second);
}

TEST_F(ExtendedRun, IsKilledAndGoesOnFromTheSameBase) {
  AddPhoto("added.jpg");
  EXPECT_EQ(RunFox({}, {{"FAKE_FAIL", "work/train"}}).exit_code, 3);
  const std::string base = HashTree(root_ / "work/base");
  AddPhoto("later.jpg");  // the model of two photos was never made
  Ran();
  EXPECT_EQ(RunFox().exit_code, 0);
  EXPECT_EQ(HashTree(root_ / "work/base"), base);
  EXPECT_THAT(Ran(),
              ElementsAre("ingest", "ingest+", "sfm", "sfm+", "pose", "pose+", "train", "train+", "render", "eval"));
}

TEST_F(ExtendedRun, IsNoneWherePhotosChangedAndSaysSo) {
  AddPhoto("added.jpg");
  WriteFileAtomically(root_ / "fox/photo.jpg", "another");
  const std::string text =
      "not only were photos added: nothing of the last run is taken over, since photo.jpg was changed";
  EXPECT_THAT(Nrff({"plan", Path("fox"), "--workspace", Path("work")}).out, HasSubstr(text));
  EXPECT_THAT(RunFox().err, HasSubstr("warning: work: " + text));
  EXPECT_THAT(Ran(), ElementsAre("ingest", "sfm", "pose", "train", "render", "eval"));
  EXPECT_FALSE(fs::exists(root_ / "work/base"));
}

TEST_F(ExtendedRun, IsNoneOfAnExtensionWherePhotosOfItsBaseChanged) {
  AddPhoto("added.jpg");
  RunFox();
  Ran();
  WriteFileAtomically(root_ / "fox/photo.jpg", "another");
  EXPECT_EQ(RunFox().exit_code, 0);
  EXPECT_THAT(Ran(), ElementsAre("ingest", "ingest+", "sfm", "pose", "train", "render", "eval"));
  RunFox();
  EXPECT_THAT(Ran(), IsEmpty());
}

TEST_F(ExtendedRun, IsNoneWhenEverythingIsAskedForAnew) {
  AddPhoto("added.jpg");
  RunFox({"--force"});
  EXPECT_THAT(Ran(), ElementsAre("ingest", "sfm", "pose", "train", "render", "eval"));
  EXPECT_FALSE(fs::exists(root_ / "work/base"));
  RunFox();
  EXPECT_THAT(Ran(), IsEmpty());
}

TEST_F(DriverTest, SameBytesFromIngestLeaveTheRestFresh) {
  RunFox();
  Ran();
  fs::remove(root_ / "work/ingest/manifest.json");
  RunFox();
  EXPECT_THAT(Ran(), ElementsAre("ingest"));
}

TEST_F(DriverTest, GivenPosesLeaveSfmOut) {
  const ProgramResult plan = Nrff({"plan", Path("fox")}, {{"FAKE_POSED", "1"}});
  EXPECT_EQ(plan.exit_code, 0) << plan.err;
  EXPECT_THAT(plan.out, HasSubstr("left out: sfm"));
  EXPECT_FALSE(fs::exists("work"));
  EXPECT_EQ(RunFox({}, {{"FAKE_POSED", "1"}}).exit_code, 0);
  EXPECT_THAT(Ran(), ElementsAre("ingest", "pose", "train", "render", "eval"));
}

TEST_F(DriverTest, WhatTrainingWouldRefuseIsRefusedFirst) {
  const ProgramResult refused = RunFox({"--preset", "huge"});
  EXPECT_EQ(refused.exit_code, 2);
  EXPECT_THAT(refused.Errors(), ElementsAre("--preset 'huge' is not known"));
  EXPECT_THAT(Ran(), IsEmpty());
  EXPECT_FALSE(fs::exists(root_ / "work"));
  EXPECT_EQ(RunFox({"--preset", "huge", "--until", "pose"}).exit_code, 2);  // or the workspace would remember it
}

TEST_F(DriverTest, MistypedCommandLinesNameTheHelpThatHelps) {
  EXPECT_THAT(Nrff({}).err, HasSubstr("give a command: run, plan,"));
  EXPECT_THAT(Nrff({"pln", "fox"}).err, HasSubstr("'pln' is no command; give run, plan,"));
  EXPECT_THAT(Nrff({"run", "fox", "--sed", "3"}).err, HasSubstr("--sed (see nrff run --help)"));
  EXPECT_THAT(Nrff({"render", Path("fox"), "--path", "orbitt", "-o", "x.mp4"}).err,
              HasSubstr("'orbitt' is neither orbit nor spiral nor a file of poses"));
}

TEST_F(DriverTest, StatusTellsTheScoresAndWhereTheReportIs) {
  RunFox({"--until", "pose"});
  EXPECT_THAT(Nrff({"status", Path("work")}).out, Not(HasSubstr("report.html")));
  RunFox();
  EXPECT_THAT(Nrff({"status", Path("work")}).out, HasSubstr("report   " + Path("work/report/report.html")));
  const Json status = Json::parse(Nrff({"status", Path("work"), "--json"}).out);
  EXPECT_EQ(status["workspaces"][0]["report"], Path("work/report/report.html"));
  EXPECT_EQ(status["workspaces"][0]["metrics"]["psnr"], 21.5);
  EXPECT_THAT(Nrff({"status", Path("work")}).out, HasSubstr("held out PSNR 21.50 dB, SSIM 0.7500"));
}

TEST_F(DriverTest, FailureSaysWhatAndWhereAndIsRemembered) {
  const ProgramResult result = RunFox({}, {{"FAKE_FAIL", "work/train"}});
  EXPECT_EQ(result.exit_code, 3);
  EXPECT_THAT(result.Errors(),
              ElementsAre(HasSubstr("train: work/train was told to fail (log: " + Path("work/logs/train.log"))));
  EXPECT_THAT(ReadFile(root_ / "work/logs/train.log"), HasSubstr("was told to fail"));

  const ProgramResult status = Nrff({"status", Path("work"), "--json"});
  EXPECT_EQ(status.exit_code, 0) << status.err;
  const Json stages = Json::parse(status.out).at("workspaces").at(0).at("stages");
  EXPECT_EQ(stages.at(2).at("state"), "done");
  EXPECT_EQ(stages.at(3).at("state"), "failed");
  EXPECT_EQ(stages.at(3).at("exit_code"), 3);
  EXPECT_THAT(stages.at(3).at("reason").get<std::string>(), HasSubstr("was told to fail"));
  EXPECT_EQ(stages.at(4).at("state"), "missing");

  Ran();
  EXPECT_EQ(RunFox().exit_code, 0);
  EXPECT_THAT(Ran(), ElementsAre("train", "render", "eval"));
  EXPECT_THAT(Nrff({"status", Path("work")}).out, Not(HasSubstr("failed")));
}

TEST_F(DriverTest, FailureKeepsWhatWasCompleteBefore) {
  RunFox({"--steps", "10"});
  const std::string model = HashTree(root_ / "work/train"), report = HashTree(root_ / "work/report");
  EXPECT_EQ(RunFox({"--steps", "20"}, {{"FAKE_FAIL", "work/train"}}).exit_code, 3);
  EXPECT_EQ(HashTree(root_ / "work/train"), model);
  EXPECT_EQ(HashTree(root_ / "work/report"), report);
}

TEST_F(DriverTest, OneCaptureThatFailsDoesNotStopTheOthers) {
  MakeCapture("castle");
  MakeCapture("other/fox");
  const std::vector<std::string> command = {"run",         Path("fox"),  Path("castle"), Path("other/fox"),
                                            "--workspace", Path("work"), "--json"};
  const ProgramResult result = Nrff(command, {{"FAKE_FAIL", "castle/sfm"}});
  EXPECT_EQ(result.exit_code, 3) << result.err;
  const Json captures = Json::parse(result.out).at("captures");
  ASSERT_EQ(captures.size(), 3u);
  EXPECT_EQ(captures[0].at("exit_code"), 0);
  EXPECT_EQ(captures[1].at("exit_code"), 3);
  EXPECT_EQ(captures[2].at("workspace"), Path("work/fox-2"));
  EXPECT_TRUE(fs::exists(root_ / "work/fox-2/report/report.html"));
  EXPECT_TRUE(fs::exists(root_ / "work/report/report.html"));
  Ran();
  EXPECT_EQ(Nrff(command).exit_code, 0);
  EXPECT_THAT(Ran(), ElementsAre("sfm", "pose", "train", "render", "eval"));
  EXPECT_EQ(Json::parse(Nrff({"status", Path("work"), "--json"}).out).at("workspaces").size(), 3u);
}

TEST_F(DriverTest, SecondRunOfTheWorkspaceIsLockedOutAndNamesTheFirst) {
  Program first(CommandOf({"run", Path("fox"), "--workspace", Path("work")}), Options({{"FAKE_HANG", "work/train"}}));
  WaitUntilHanging();
  const ProgramResult second = RunFox();
  EXPECT_EQ(second.exit_code, 7);
  EXPECT_THAT(second.Errors(), ElementsAre(HasSubstr("in use by process " + std::to_string(first.pid()))));
  EXPECT_THAT(Nrff({"status", Path("work")}).out, HasSubstr("in use by process " + std::to_string(first.pid())));
}

TEST_F(DriverTest, TerminationEndsTheStagesAndTheNextRunGoesOn) {
  for (const int signal : {SIGTERM, SIGINT}) {
    Program run(CommandOf({"run", Path("fox"), "--workspace", Path("work")}), Options({{"FAKE_HANG", "work/train"}}));
    const pid_t stage = WaitUntilHanging();
    kill(run.pid(), signal);
    EXPECT_EQ(run.Wait().exit_code, 128 + signal);
    EXPECT_TRUE(IsGone(stage));
    Ran();
  }
  EXPECT_EQ(RunFox().exit_code, 0);
  EXPECT_THAT(Ran(), ElementsAre("train", "render", "eval"));
}

TEST_F(DriverTest, KilledRunTakesItsStagesAlongAndTheNextRunGoesOn) {
  Program run(CommandOf({"run", Path("fox"), "--workspace", Path("work")}), Options({{"FAKE_HANG", "work/pose"}}));
  const pid_t stage = WaitUntilHanging();
  run.KillAlone();
  EXPECT_EQ(run.Wait().exit_code, 128 + SIGKILL);
  EXPECT_TRUE(IsGone(stage));
  Ran();
  EXPECT_EQ(RunFox().exit_code, 0);
  EXPECT_THAT(Ran(), ElementsAre("pose", "train", "render", "eval"));
}

TEST_F(DriverTest, FoldersThatAreNotTheCapturesWorkspaceAreLeftAlone) {
  EXPECT_EQ(Nrff({"run", Path("fox"), "--workspace", Path("fox")}).exit_code, 3);
  EXPECT_FALSE(fs::exists(root_ / "fox/nrff-workspace.json"));
  RunFox({"--until", "ingest"});
  const ProgramResult other = Nrff({"run", MakeCapture("castle").string(), "--workspace", Path("work")});
  EXPECT_EQ(other.exit_code, 3);
  EXPECT_THAT(other.Errors(), ElementsAre(HasSubstr("is the workspace of " + Path("fox"))));
  EXPECT_EQ(Nrff({"run", Path("nowhere")}).exit_code, 3);
  EXPECT_EQ(Nrff({"run", Path("fox"), Path("fox"), "--workspace", Path("both")}).exit_code, 2);
}

TEST_F(DriverTest, EvalRunsNothingButEvalAndReport) {
  RunFox({"--steps", "10"});
  WriteFileAtomically(root_ / "fox/photo.jpg", "another");
  Ran();
  Nrff({"eval", Path("work")});
  EXPECT_THAT(Ran(), ElementsAre("eval"));
  EXPECT_EQ(Nrff({"eval", Path("fox")}).exit_code, 3);
}

TEST_F(DriverTest, EvalWithoutRendersSaysHowToMakeThemAndRecordsNothing) {
  RunFox({"--until", "pose"});
  const ProgramResult result = Nrff({"eval", Path("work")});
  EXPECT_EQ(result.exit_code, 3);
  EXPECT_THAT(result.err, HasSubstr("has no finished render yet: `nrff run " + Path("work") + "` makes it"));
  EXPECT_FALSE(Workspace(Path("work")).LastRecord("eval"));
}

TEST_F(DriverTest, PathIsEncodedOrKeptAsFramesWithTheWayToGetFfmpeg) {
  RunFox();
  fs::create_directories(root_ / "tools");
  std::ofstream(root_ / "tools/ffmpeg") << "#!/bin/sh\nfor last; do :; done\necho video > \"$last\"\n";
  fs::permissions(root_ / "tools/ffmpeg", fs::perms::owner_all);
  const std::vector<std::string> to_video = {"render", Path("work"), "--path", "orbit", "-o", Path("orbit.mp4")};
  const ProgramResult result = Nrff(to_video, {{"PATH", Path("tools") + ":/bin:/usr/bin"}});
  EXPECT_EQ(result.exit_code, 0) << result.err;
  EXPECT_EQ(ReadFile(root_ / "orbit.mp4"), "video\n");

  fs::remove(root_ / "orbit.mp4");
  const ProgramResult without = Nrff(to_video, {{"PATH", Path("nowhere")}});
  EXPECT_EQ(without.exit_code, 4);
  EXPECT_THAT(without.Errors(), ElementsAre(HasSubstr("apt-get install ffmpeg")));
  EXPECT_TRUE(fs::exists(root_ / "work/paths/orbit/rgb/000000.png"));
  EXPECT_FALSE(fs::exists(root_ / "orbit.mp4"));

  fs::create_directories(root_ / "frames");
  WriteFileAtomically(root_ / "frames/000001.png", "of an earlier, longer path");
  EXPECT_EQ(Nrff({"render", Path("work"), "-o", Path("frames")}).exit_code, 0);
  EXPECT_TRUE(fs::exists(root_ / "frames/000000.png"));
  EXPECT_FALSE(fs::exists(root_ / "frames/000001.png"));
  const ProgramResult mixed = Nrff({"render", Path("work"), "-o", Path("fox")});
  EXPECT_EQ(mixed.exit_code, 2);
  EXPECT_THAT(mixed.err, HasSubstr("which holds photo.jpg"));
  EXPECT_EQ(Nrff({"render", Path("work"), "-o", Path("orbit.avi")}).exit_code, 2);
}

TEST_F(DriverTest, HelpFitsAScreenAndShowsAnExample) {
  for (const std::string command : {"", "run", "plan", "status", "render", "eval", "report", "benchmark",
                                    "benchmark llff", "benchmark nerf-synthetic", "benchmark work-precision"}) {
    std::istringstream words(command + " --help");
    const std::vector<std::string> arguments{std::istream_iterator<std::string>(words), {}};
    const ProgramResult help = Nrff(arguments);
    EXPECT_EQ(help.exit_code, 0);
    EXPECT_THAT(help.out, HasSubstr("Example: nrff ")) << command;
    std::istringstream lines(help.out);
    int n_lines = 0;
    for (std::string line; std::getline(lines, line); ++n_lines) EXPECT_LE(line.size(), 80u) << line;
    EXPECT_LE(n_lines, 40) << command;
  }
}

TEST_F(DriverTest, QuietRunSaysNothing) {
  const ProgramResult result = RunFox({"--quiet"});
  EXPECT_EQ(result.exit_code, 0);
  EXPECT_EQ(result.out + result.err, "");
}

}  // namespace
}  // namespace nrff
