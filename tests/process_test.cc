// Child processes: how they end is told apart, and nothing they started outlives them.
#include "pipeline/process.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <unistd.h>

#include <csignal>
#include <fstream>
#include <thread>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "tests/temporary_directory.h"

namespace nrff {
namespace {

using End = ProcessResult::End;
using ::testing::ElementsAre;
using ::testing::HasSubstr;

ProcessOptions Shell(const std::string& script) {
  ProcessOptions options;
  options.command = {"sh", "-c", script};
  return options;
}

// Whether the process is gone, or will be within two seconds.
bool Ends(pid_t pid) {
  for (int i = 0; i < 200; ++i) {
    std::ifstream stat("/proc/" + std::to_string(pid) + "/stat");
    std::string text((std::istreambuf_iterator<char>(stat)), {});
    if (text.empty() || text.find(") Z") != std::string::npos) return true;
    std::this_thread::sleep_for(std::chrono::milliseconds(10));
  }
  return false;
}

TEST(Process, PassesEveryLineOnAndKeepsThemInTheLog) {
  TemporaryDirectory dir;
  ProcessOptions options = Shell("echo one; echo two >&2; printf 'three\\rfour'");
  options.log = dir.path() / "log";
  std::vector<std::string> lines;
  options.on_line = [&](std::string_view line) { lines.emplace_back(line); };
  const ProcessResult result = RunProcess(options);
  EXPECT_TRUE(result.Succeeded());
  EXPECT_THAT(lines, ElementsAre("one", "two", "three", "four"));
  EXPECT_EQ(result.last_lines, lines);
  EXPECT_THAT(ReadFile(options.log), HasSubstr("one\ntwo\nthree\rfour"));
  EXPECT_GT(result.peak_memory_bytes, 0u);
}

TEST(Process, GivesTheExitStatusAndTheSignalThatEndedIt) {
  EXPECT_EQ(RunProcess(Shell("exit 7")).exit_code, 7);
  const ProcessResult killed = RunProcess(Shell("kill -SEGV $$"));
  EXPECT_EQ(killed.end, End::kSignalled);
  EXPECT_EQ(killed.signal, SIGSEGV);
  EXPECT_THAT(DescribeEnd(killed), HasSubstr("signal 11"));
}

TEST(Process, AProgramThatIsNotThereIsAnError) {
  ProcessOptions options;
  options.command = {"nrff-no-such-program"};
  try {
    RunProcess(options);
    FAIL();
  } catch (const Error& error) {
    EXPECT_EQ(error.code(), ExitCode::kExternalTool);
    EXPECT_THAT(error.what(), HasSubstr("nrff-no-such-program"));
  }
}

TEST(Process, StopsTheWholeGroupAtTheTimeLimit) {
  TemporaryDirectory dir;
  ProcessOptions options = Shell("sleep 60 & echo $! > " + (dir.path() / "pid").string() + "; wait");
  options.limit_seconds = 0.3;
  const ProcessResult result = RunProcess(options);
  EXPECT_EQ(result.end, End::kTimeLimit);
  EXPECT_LT(result.seconds, 3);
  EXPECT_TRUE(Ends(std::stoi(ReadFile(dir.path() / "pid"))));
}

TEST(Process, AProcessThatIgnoresTheRequestToEndIsKilled) {
  ProcessOptions options = Shell("trap '' TERM; while :; do :; done");
  options.limit_seconds = 0.2;
  const ProcessResult result = RunProcess(options);
  EXPECT_EQ(result.end, End::kTimeLimit);
  EXPECT_EQ(result.signal, SIGKILL);
}

TEST(Process, SilenceWithoutProcessorUseIsAStall) {
  ProcessOptions options = Shell("sleep 60");
  options.stall_limit_seconds = 0.5;
  EXPECT_EQ(RunProcess(options).end, End::kStalled);
}

TEST(Process, SilentWorkIsNotAStall) {
  ProcessOptions options = Shell("(i=0; while [ $i -lt 400000 ]; do i=$((i+1)); done); exit 3");
  options.stall_limit_seconds = 0.2;
  const ProcessResult result = RunProcess(options);
  EXPECT_EQ(result.end, End::kExited);
  EXPECT_EQ(result.exit_code, 3);
}

TEST(Process, IsStoppedWhenCancelled) {
  std::atomic<bool> cancel = false;
  ProcessOptions options = Shell("sleep 60");
  options.cancel = &cancel;
  std::thread other([&] {
    std::this_thread::sleep_for(std::chrono::milliseconds(100));
    cancel = true;
  });
  EXPECT_EQ(RunProcess(options).end, End::kCancelled);
  other.join();
}

TEST(Process, ProgressLinesComeByTheirOwnDescriptor) {
  ProcessOptions options = Shell("echo shown; echo '{\"done\":1}' >&$NRFF_PROGRESS_FD");
  std::vector<std::string> output, progress;
  options.on_line = [&](std::string_view line) { output.emplace_back(line); };
  options.on_progress = [&](std::string_view line) { progress.emplace_back(line); };
  EXPECT_TRUE(RunProcess(options).Succeeded());
  EXPECT_THAT(output, ElementsAre("shown"));
  EXPECT_THAT(progress, ElementsAre("{\"done\":1}"));
}

TEST(Process, DoesNotWaitForWhatItLeftBehind) {
  ProcessOptions options = Shell("sleep 60 & exit 0");
  const ProcessResult result = RunProcess(options);
  EXPECT_TRUE(result.Succeeded());
  EXPECT_LT(result.seconds, 5);
}

TEST(Process, ACallbackThatThrowsEndsTheProcess) {
  pid_t pid = 0;
  ProcessOptions options = Shell("echo $$; sleep 60");
  options.on_line = [&](std::string_view line) {
    pid = std::stoi(std::string(line));
    throw InputError("enough");
  };
  EXPECT_THROW(RunProcess(options), Error);
  ASSERT_GT(pid, 0);
  EXPECT_TRUE(Ends(pid));
}

}  // namespace
}  // namespace nrff
