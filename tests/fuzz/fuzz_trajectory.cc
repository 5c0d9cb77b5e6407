// Tanks & Temples' trajectories: a .log file and the similarity of trans.txt.
#include <cmath>

#include "sfm/trajectory.h"
#include "tests/fuzz/fuzz.h"

namespace nrff::fuzz {

std::vector<std::string> Seeds() {
  const std::string pose = "0 0 1 0.5\n1 0 0 -2\n0 1 0 3e-1\n0 0 0 1\n";
  return {Join({"0 0 0\n" + pose + "1 1 0\n" + pose, "0 -2 0 1\n2 0 0 2\n0 0 2 3\n0 0 0 1\n"})};
}

}  // namespace nrff::fuzz

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace nrff;  // NOLINT(google-build-using-namespace)
  const std::filesystem::path log = fuzz::Folder() / "poses.log", similarity = fuzz::Folder() / "trans.txt";
  const auto files = fuzz::Split(data, size, 2);
  fuzz::Write("poses.log", files[0]);
  fuzz::Write("trans.txt", files[1]);
  const auto matrix = fuzz::ParseOrError(similarity, [&] { return ReadSimilarity(similarity); });
  const auto trajectory = fuzz::ParseOrError(log, [&] { return ReadTrajectory(log); });
  if (!trajectory) return 0;
  if (matrix) static_cast<void>(Transformed(*trajectory, *matrix));
  WriteTrajectoryLog(*trajectory, log);
  const Trajectory again = ReadTrajectory(log);
  fuzz::Require(again.size() == trajectory->size(), "as many poses are read as were written");
  for (size_t i = 0; i < again.size(); ++i) {
    const TrajectoryPose &a = (*trajectory)[i], &b = again[i];
    fuzz::Require(a.center == b.center, "a position that is written is read as it was");
    fuzz::Require(a.rotation.angularDistance(b.rotation) < 1e-7, "a rotation that is written is read as it was");
  }
  return 0;
}
