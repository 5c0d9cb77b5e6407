// The driver as users run it: real processes, with stages that stand in for the real ones (fake_stage.cc).
#pragma once

#include <gtest/gtest.h>
#include <unistd.h>

#include <chrono>
#include <filesystem>
#include <fstream>
#include <map>
#include <string>
#include <thread>
#include <vector>

#include "pipeline/files.h"
#include "tests/program.h"
#include "tests/temporary_directory.h"

namespace nrff {

namespace fs = std::filesystem;

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

}  // namespace nrff
