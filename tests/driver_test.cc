// The driver as users run it: real processes, with stages that stand in for the real ones (fake_stage.cc).
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <unistd.h>

#include <chrono>
#include <fstream>
#include <sstream>
#include <thread>

#include "pipeline/commands.h"
#include "pipeline/disk.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"
#include "pipeline/local_executor.h"
#include "pipeline/progress_view.h"
#include "pipeline/workspace.h"
#include "tests/program.h"
#include "tests/temporary_directory.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using ::testing::IsSupersetOf;
using ::testing::Not;

class DriverTest : public ::testing::Test {
 protected:
  DriverTest() {
    fs::create_directories(root_ / "bin");
    fs::copy_file(fs::path(NRFF_BIN_DIR) / "nrff", root_ / "bin" / "nrff");
    for (const char* stage : {"nrff-ingest", "nrff-pose", "nrff-train", "nrff-render", "nrff-eval"}) {
      fs::create_symlink(fs::canonical("/proc/self/exe").parent_path() / "fake_stage", root_ / "bin" / stage);
    }
    MakeCapture("fox");
  }

  fs::path MakeCapture(const std::string& name) {
    fs::create_directories(root_ / name);
    WriteFileAtomically(root_ / name / "photo.jpg", name);
    return root_ / name;
  }

  std::vector<std::string> CommandOf(std::vector<std::string> arguments) const {
    arguments.insert(arguments.begin(), (root_ / "bin" / "nrff").string());
    return arguments;
  }

  ProgramOptions Options(std::map<std::string, std::string> environment) const {
    environment.emplace("FAKE_LOG", (root_ / "runs").string());
    return {environment};
  }

  ProgramResult Nrff(const std::vector<std::string>& arguments,
                     const std::map<std::string, std::string>& environment = {}) {
    return RunProgram(CommandOf(arguments), Options(environment));
  }

  // `nrff run fox` with these arguments besides.
  ProgramResult RunFox(std::vector<std::string> arguments = {},
                       const std::map<std::string, std::string>& environment = {}) {
    arguments.insert(arguments.begin(), {"run", Path("fox"), "--workspace", Path("work")});
    return Nrff(arguments, environment);
  }

  std::string Path(const std::string& name) const { return (root_ / name).string(); }

  // The stages that ran since this was last asked, without the branch.
  std::vector<std::string> Ran() {
    std::vector<std::string> stages;
    std::ifstream file(root_ / "runs");
    for (std::string line; std::getline(file, line);) {
      if (line.find('/') != std::string::npos) stages.push_back(line.substr(line.find('/') + 1));
    }
    file.close();
    fs::remove(root_ / "runs");
    return stages;
  }

  // The process that hangs, once it does.
  pid_t WaitUntilHanging() const {
    for (int i = 0; i < 400; ++i) {
      std::ifstream file(root_ / "runs");
      for (std::string line; std::getline(file, line);) {
        if (line.starts_with("hanging ")) return std::stoi(line.substr(8));
      }
      std::this_thread::sleep_for(std::chrono::milliseconds(25));
    }
    ADD_FAILURE() << "no stage came to hang";
    return 0;
  }

  static bool IsGone(pid_t pid) {
    for (int i = 0; i < 200; ++i) {
      std::ifstream stat("/proc/" + std::to_string(pid) + "/stat");
      std::string text;
      if (!std::getline(stat, text) || text.substr(text.rfind(')') + 2, 1) == "Z") return true;
      std::this_thread::sleep_for(std::chrono::milliseconds(25));
    }
    return false;
  }

  TemporaryDirectory directory_;
  const fs::path root_ = fs::canonical(directory_.path());
};

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
  const Params expected = {{"preset", "tiny"}, {"budget-seconds", "60"}};
  EXPECT_EQ(ReadManifest(root_ / "work/train")->params, expected);
  RunFox({"--preset", "tiny", "--budget", "60s", "--threads", "1"});
  EXPECT_THAT(Ran(), IsEmpty());
  EXPECT_EQ(RunFox({"--steps", "20", "--budget", "1m"}).exit_code, 2);
}

TEST_F(DriverTest, ForcedDecisionsGoToTheStagesThatMakeThem) {
  RunFox();
  Ran();
  const ProgramResult forced =
      RunFox({"--need", "undistortion", "--leave-out", "sparse_depth", "--leave-out", "exhaustive_matching"});
  EXPECT_EQ(forced.exit_code, 0) << forced.err;
  EXPECT_EQ(ReadManifest(root_ / "work/sfm")->params, (Params{{"matching", "sequential"}}));
  EXPECT_EQ(ReadManifest(root_ / "work/pose")->params, (Params{{"undistortion", "on"}}));
  EXPECT_EQ(ReadManifest(root_ / "work/train")->params, (Params{{"sparse-depth", "off"}}));
  const ProgramResult both = RunFox({"--need", "contraction", "--leave-out", "contraction"});
  EXPECT_EQ(both.exit_code, 2);
  EXPECT_THAT(both.err, HasSubstr("--need and --leave-out both name contraction"));
  for (const char* malformed : {"levels=3", "field.levels", "field.=3", "field.levels="}) {
    EXPECT_EQ(RunFox({"--set", malformed}).exit_code, 2) << malformed;
  }
  const ProgramResult unknown = RunFox({"--leave-out", "training"});
  EXPECT_EQ(unknown.exit_code, 2);
  EXPECT_THAT(unknown.err, HasSubstr("nothing that can be forced"));
}

TEST_F(DriverTest, WorkspaceStandsForItsCaptureAndLastOptions) {
  RunFox({"--steps", "10"});
  Ran();
  EXPECT_EQ(Nrff({"run", Path("work")}).exit_code, 0);
  EXPECT_THAT(Ran(), IsEmpty());
  Nrff({"run", Path("work"), "--steps", "11"});
  EXPECT_THAT(Ran(), ElementsAre("train", "render", "eval"));
  Nrff({"run", Path("work"), "--budget", "1m"});
  EXPECT_EQ(ReadManifest(root_ / "work/train")->params, (Params{{"budget-seconds", "60"}}));
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

TEST_F(DriverTest, PlanAndDryRunTellReasonsAndWriteNothing) {
  const ProgramResult dry = RunFox({"--dry-run", "--json"});
  EXPECT_EQ(dry.exit_code, 0) << dry.err;
  const Json plan = Json::parse(dry.out);
  const Json& nodes = plan.at("captures").at(0).at("nodes");
  ASSERT_EQ(nodes.size(), 7u);
  EXPECT_EQ(nodes[0].at("state"), "run");
  EXPECT_EQ(nodes[0].at("reason"), "has not been made");
  EXPECT_THAT(Ran(), IsEmpty());
  EXPECT_FALSE(fs::exists(root_ / "work"));

  RunFox({"--steps", "10"});
  const Json again = Json::parse(Nrff({"plan", Path("work"), "--steps", "11", "--json"}).out);
  const Json& later = again.at("captures").at(0).at("nodes");
  EXPECT_EQ(later[2].at("state"), "reuse");
  EXPECT_EQ(later[3].at("reason"), "was made with --steps 10, now it is 11");
  EXPECT_EQ(later[4].at("state"), "decide");
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
  EXPECT_EQ(stages.at(4).at("state"), "stale");

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

  EXPECT_EQ(Nrff({"render", Path("work"), "-o", Path("frames")}).exit_code, 0);
  EXPECT_TRUE(fs::exists(root_ / "frames/000000.png"));
  EXPECT_EQ(Nrff({"render", Path("work"), "-o", Path("orbit.avi")}).exit_code, 2);
}

TEST_F(DriverTest, HelpFitsAScreenAndShowsAnExample) {
  for (const char* command : {"", "run", "plan", "status", "render", "eval", "report"}) {
    std::vector<std::string> arguments = {"--help"};
    if (*command != '\0') arguments.insert(arguments.begin(), command);
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

TEST(DurationTest, UnitsAddUpAndNonsenseIsRefused) {
  EXPECT_EQ(ParseDuration("90s", "--budget"), 90);
  EXPECT_EQ(ParseDuration("10m", "--budget"), 600);
  EXPECT_EQ(ParseDuration("1h30m", "--budget"), 5400);
  EXPECT_EQ(ParseDuration("1.5h", "--budget"), 5400);
  EXPECT_EQ(ParseDuration("600", "--budget"), 600);
  for (const char* text : {"", "m", "-5m", "10x", "10m5", "0", "1e999s", "nan", "inf", " 5m", "5 m"}) {
    EXPECT_THROW(ParseDuration(text, "--budget"), Error) << text;
  }
}

TEST(WorkspaceTest, NamesAreSafeAndOneForEachCapture) {
  const TemporaryDirectory directory;
  const fs::path root = directory.path();
  EXPECT_EQ(CaptureName("/a/my fox"), "my_fox");
  EXPECT_EQ(CaptureName("/a/ch\xC3\xA2teau"), "ch\xC3\xA2teau");
  EXPECT_EQ(CaptureName("/a/.hidden"), "hidden");
  EXPECT_EQ(CaptureName("/a/\xFF\n"), "_FF_0A");
  EXPECT_EQ(CaptureName("/"), "capture");

  EXPECT_EQ(WorkspaceFor("/a/report", root / "work", {}).root(), root / "work/report-2");
  const Workspace first = WorkspaceFor("/a/fox", root / "work", {});
  EXPECT_EQ(first.root(), root / "work/fox");
  EXPECT_EQ(WorkspaceFor("/b/fox", root / "work", {first.root()}).root(), root / "work/fox-2");
  first.Claim("/a/fox");
  EXPECT_EQ(WorkspaceFor("/b/fox", root / "work", {}).root(), root / "work/fox-2");
  EXPECT_EQ(WorkspaceFor("/a/fox", root / "work", {}).root(), root / "work/fox");
}

TEST(RealDiskTest, OnlyWholeArtifactsCountAndNewerOnesAreNotTouched) {
  const TemporaryDirectory directory;
  const fs::path out = directory.path() / "train";
  RealDisk disk;
  EXPECT_EQ(disk.ReadArtifact(out).problem, "has not been made");
  const auto make = [&] {
    ArtifactWriter artifact("train", out, {}, {});
    EXPECT_EQ(disk.ReadArtifact(out).problem, "was begun but not finished");
    WriteFileAtomically(artifact.dir() / "model", "weights");
    artifact.AddOutput("model");
    artifact.Commit();
  };
  make();
  EXPECT_TRUE(disk.ReadArtifact(out).manifest);
  fs::resize_file(out / "model", 3);
  EXPECT_THAT(disk.ReadArtifact(out).problem, HasSubstr("model"));
  fs::remove(out / "model");
  EXPECT_THAT(disk.ReadArtifact(out).problem, HasSubstr("model"));

  const std::string manifest = ReadFile(out / kManifestName);
  for (size_t size = 0; size + 1 < manifest.size(); size += 7) {  // cut anywhere
    WriteFileAtomically(out / kManifestName, manifest.substr(0, size));
    EXPECT_FALSE(disk.ReadArtifact(out).manifest) << size;
  }
  Json newer = Json::parse(manifest);
  newer["schema_version"] = kManifestSchemaVersion + 1;
  WriteJson(out / kManifestName, newer);
  EXPECT_THROW(disk.ReadArtifact(out), Error);
}

TEST(LocalExecutorTest, ProgressLinesAndErrorsComeThroughAndJobsRunAtOnce) {
  const TemporaryDirectory directory;
  LocalExecutor executor;
  std::vector<std::string> lines;
  double done = 0;
  const auto start = std::chrono::steady_clock::now();
  Job job;
  job.command = {
      "sh", "-c",
      R"(echo '{"what":"w","done":3,"total":4,"unit":"u","seconds_left":null,"text":""}' >/proc/self/fd/$NRFF_PROGRESS_FD
                    echo nonsense >/proc/self/fd/$NRFF_PROGRESS_FD; echo out; echo 'error: too bad' >&2; sleep 0.5; exit 5)"};
  job.log = directory.path() / "log";
  job.on_line = [&](const std::string& line) { lines.push_back(line); };
  job.on_progress = [&](const ProgressUpdate& update) {
    done = update.done;
    EXPECT_FALSE(update.seconds_left);
  };
  executor.Start(job);
  executor.Start({{"sh", "-c", "sleep 0.5; kill -KILL $$"}, {}, {}, {}});
  executor.Start({{"/nowhere/program"}, {}, {}, {}});
  std::map<int, JobResult> results;
  for (int i = 0; i < 3; ++i) {
    const Executor::Finished finished = executor.Wait();
    results[finished.job] = finished.result;
  }
  EXPECT_LT(std::chrono::steady_clock::now() - start, std::chrono::milliseconds(950));
  EXPECT_EQ(results[0].exit_code, 5);
  EXPECT_EQ(results[0].error, "too bad");
  EXPECT_GT(results[0].peak_memory_bytes, 100000u);
  EXPECT_THAT(lines, IsSupersetOf({"out", "error: too bad"}));
  EXPECT_THAT(ReadFile(directory.path() / "log"), HasSubstr("too bad"));
  EXPECT_EQ(done, 3);
  EXPECT_EQ(results[1].exit_code, 128 + SIGKILL);
  EXPECT_THAT(results[1].error, HasSubstr("signal 9"));
  EXPECT_EQ(results[2].exit_code, static_cast<int>(ExitCode::kExternalTool));
  EXPECT_EQ(executor.StopSignal(), 0);
}

TEST(ProgressViewTest, TerminalKeepsOneBarPerStageBelowTheLines) {
  std::ostringstream out;
  std::chrono::steady_clock::time_point now{};
  ProgressView view(
      out, [] { return 80; }, [&] { return now; });
  view.Begin("fox/train");
  view.Begin("castle/sfm");
  now += std::chrono::seconds(3);
  out.str("");
  view.Update("fox/train", {"training", "steps", "loss 0.1", 50, 200, 30.0});
  EXPECT_THAT(out.str(), HasSubstr("\033[2A"));  // both bars are drawn over
  EXPECT_THAT(out.str(), HasSubstr("fox/train   [######------------------]  25 %  training 50/200 steps, 30 s left"));
  EXPECT_THAT(out.str(), HasSubstr("castle/sfm  3.0 s\n"));
  std::istringstream lines(out.str());
  for (std::string line; std::getline(lines, line);) EXPECT_LE(line.size(), 80u + 8);  // 8: the escape sequence
  out.str("");
  view.End("castle/sfm");
  view.Print("a line");
  EXPECT_THAT(out.str(), HasSubstr("\033[1A\r\033[Ja line\nfox/train"));
}

TEST(ProgressViewTest, ElsewhereAPlainLineEveryTenSeconds) {
  std::ostringstream out;
  std::chrono::steady_clock::time_point now{};
  ProgressView view(
      out, [] { return 0; }, [&] { return now; });
  view.Begin("train");
  for (int second = 0; second < 25; ++second) {
    now += std::chrono::seconds(1);
    view.Update("train", {"training", "steps", "", double(second), 25, {}});
    view.Tick();
  }
  view.End("train");
  EXPECT_EQ(out.str(), "train: training 9/25 steps\ntrain: training 19/25 steps\n");
}

}  // namespace
}  // namespace nrff
