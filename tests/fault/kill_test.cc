// A run that is killed (SIGKILL: nothing is tidied up) at any moment and started again ends in the same artifacts as
// one that was left alone.
#include <gtest/gtest.h>
#include <signal.h>

#include <chrono>
#include <map>
#include <random>
#include <thread>

#include "pipeline/files.h"
#include "pipeline/manifest.h"
#include "tests/program.h"
#include "tests/temporary_directory.h"
#include "tests/test_photos.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr int kKills = 10;  // of the driver alone, and as many of all its processes

void Sleep(double seconds) { std::this_thread::sleep_for(std::chrono::duration<double>(seconds)); }

class Kill : public testing::Test {
 protected:
  void SetUp() override {
    MakeExampleCapture(capture_, {"--posed", "--views", "10", "--width", "64", "--height", "48", "--samples", "1"});
  }

  // One thread makes training repeat bit by bit.
  std::vector<std::string> Command(const fs::path& workspace) const {
    return {"nrff",    "run", capture_.string(), "-w", workspace.string(), "--preset", "tiny",
            "--steps", "40",  "--threads",       "1",  "--seed",           "3",        "--quiet"};
  }

  // Stage → content hash. The report holds times and is only known to be there.
  static std::map<std::string, std::string> Contents(const fs::path& workspace) {
    std::map<std::string, std::string> hashes;
    for (const char* stage : {"ingest", "pose", "train", "render", "eval"}) {
      const auto manifest = ReadManifest(workspace / stage);
      hashes[stage] = manifest ? manifest->ContentHash() : "absent";
    }
    hashes["report"] = fs::exists(workspace / "report" / "summary.json") ? "present" : "absent";
    return hashes;
  }

  static std::vector<fs::path> Unfinished(const fs::path& workspace) {
    std::vector<fs::path> partial;
    for (const auto& entry : fs::recursive_directory_iterator(workspace)) {
      if (entry.path().string().find(".partial") != std::string::npos) partial.push_back(entry.path());
    }
    return partial;
  }

  TemporaryDirectory temporary_;
  fs::path capture_ = temporary_.path() / "capture";
};

class KillMoments : public Kill, public testing::WithParamInterface<bool> {};

TEST_P(KillMoments, ThenRunAgainEndsInTheSameArtifacts) {
  const bool driver_alone = GetParam();
  const fs::path undisturbed = temporary_.path() / "undisturbed";
  const ProgramResult reference = RunProgram(Command(undisturbed));
  ASSERT_EQ(reference.exit_code, 0) << reference.err;
  const auto expected = Contents(undisturbed);
  for (const auto& [stage, hash] : expected) ASSERT_NE(hash, "absent") << stage;

  const uint32_t seed = driver_alone ? 2 : 1;
  std::mt19937 random(seed);
  std::cout << "undisturbed: " << reference.seconds << " s; kill moments from seed " << seed << '\n';
  for (int i = 0; i < kKills; ++i) {
    // One moment in each part of the run, so that every stage is hit.
    const double moment = reference.seconds * (i + random() / 4294967296.0) / kKills;
    SCOPED_TRACE("kill " + std::to_string(i) + " at " + std::to_string(moment) + " s");
    const fs::path workspace = temporary_.path() / ("killed-" + std::to_string(i));
    {
      Program run(Command(workspace), {});
      Sleep(moment);
      if (driver_alone) {
        run.KillAlone();
        // The stages must not go on without their driver.
        for (int wait = 0; wait < 100 && !run.Session().empty(); ++wait) Sleep(0.02);
        EXPECT_TRUE(run.Session().empty());
      }
      run.KillSession();
      run.Wait();
    }
    const ProgramResult again = RunProgram(Command(workspace));
    ASSERT_EQ(again.exit_code, 0) << again.err;
    EXPECT_EQ(Contents(workspace), expected);
    EXPECT_TRUE(Unfinished(workspace).empty()) << Unfinished(workspace).front();
    fs::remove_all(workspace);
  }
}

INSTANTIATE_TEST_SUITE_P(OfARun, KillMoments, testing::Bool(),
                         [](const auto& info) { return info.param ? "DriverAlone" : "EveryProcess"; });

TEST_F(Kill, InterruptEndsTheStagesAndSaysHowToGoOn) {
  const fs::path workspace = temporary_.path() / "interrupted";
  Program run(Command(workspace), {});
  while (!fs::exists(workspace / "ingest" / "manifest.json") && !run.Session().empty()) Sleep(0.01);
  kill(run.pid(), SIGTERM);
  const ProgramResult result = run.Wait();
  EXPECT_EQ(result.exit_code, 128 + SIGTERM) << result.err;
  EXPECT_EQ(result.Errors().size(), 1u) << result.err;
  EXPECT_TRUE(run.Session().empty());
  EXPECT_EQ(RunProgram(Command(workspace)).exit_code, 0);
}

TEST_F(Kill, SecondRunOfALockedWorkspaceIsRefused) {
  const fs::path workspace = temporary_.path() / "shared";
  Program first(Command(workspace), {});
  while (!fs::exists(workspace / "ingest") && !first.Session().empty()) Sleep(0.01);
  const ProgramResult second = RunProgram(Command(workspace));
  EXPECT_EQ(second.exit_code, 7) << second.err;
  ASSERT_EQ(second.Errors().size(), 1u) << second.err;
  EXPECT_NE(second.Errors()[0].find(std::to_string(first.pid())), std::string::npos) << second.err;
  EXPECT_EQ(first.Wait().exit_code, 0);
}

}  // namespace
}  // namespace nrff
