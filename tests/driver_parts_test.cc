// The driver's parts by themselves: durations, workspaces, the disk, processes, the bars of a terminal.
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <unistd.h>

#include <chrono>
#include <fstream>
#include <sstream>
#include <thread>

#include "pipeline/disk.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"
#include "pipeline/local_executor.h"
#include "pipeline/progress_view.h"
#include "pipeline/stage.h"
#include "pipeline/workspace.h"
#include "tests/temporary_directory.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsSupersetOf;

TEST(DurationTest, UnitsAddUpAndNonsenseIsRefused) {
  EXPECT_EQ(ParseDuration("90s", "--budget"), 90);
  EXPECT_EQ(ParseDuration("10m", "--budget"), 600);
  EXPECT_EQ(ParseDuration("1h30m", "--budget"), 5400);
  EXPECT_EQ(ParseDuration("1.5h", "--budget"), 5400);
  EXPECT_EQ(ParseDuration("600", "--budget"), 600);
  for (const char* text :
       {"", "m", "-5m", "10x", "10m5", "0", "0x10m", "1e2s", "1m-5s", "1e999s", "nan", "inf", " 5m", "5 m"}) {
    EXPECT_THROW(ParseDuration(text, "--budget"), Error) << text;
  }
}

TEST(WorkspaceTest, NamesAreSafeAndOneForEachCapture) {
  const TemporaryDirectory directory;
  const fs::path& root = directory.path();
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
