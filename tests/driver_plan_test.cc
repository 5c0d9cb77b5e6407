// `nrff plan` and --dry-run.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <sstream>
#include <string>

#include "pipeline/json.h"
#include "tests/driver_fixture.h"

namespace nrff {
namespace {

using ::testing::HasSubstr;
using ::testing::IsEmpty;
using ::testing::Not;

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

TEST_F(DriverTest, PlanTellsWhatTrainingWillDoWhatIsForcedAndWhatIsStillOpen) {
  const ProgramResult plan = Nrff({"plan", Path("fox"), "--leave-out", "sparse_depth", "--max-image-size", "400"});
  EXPECT_EQ(plan.exit_code, 0) << plan.err;
  EXPECT_THAT(plan.out, HasSubstr("training: preset small, 8000 steps, on cpu, photos of at most 400 px"));
  EXPECT_THAT(plan.out, HasSubstr("left out: sparse_depth — nothing measured yet; forced by an option"));
  EXPECT_THAT(plan.out,
              HasSubstr("measured then: exhaustive_matching, gps_pairs, second_attempt, refinement, own_focal_lengths, "
                        "undistortion, contraction, fine_levels, exposure_correction, camera_correction\n"));
  const ProgramResult posed = Nrff({"plan", Path("fox")}, {{"FAKE_POSED", "1"}});
  EXPECT_THAT(posed.out,
              HasSubstr("measured then: undistortion, contraction, sparse_depth, fine_levels, exposure_correction, "
                        "camera_correction\n"));
  const ProgramResult early = Nrff({"plan", Path("fox"), "--until", "sfm"});
  EXPECT_THAT(
      early.out,
      HasSubstr("measured then: exhaustive_matching, gps_pairs, second_attempt, refinement, own_focal_lengths\n"));
  EXPECT_THAT(early.out, Not(HasSubstr("training:")));
}

TEST_F(DriverTest, PlanExplainsEveryDecisionInATableThatFits) {
  const ProgramResult plan = Nrff({"plan", Path("fox"), "--explain", "--leave-out", "sparse_depth"});
  EXPECT_EQ(plan.exit_code, 0) << plan.err;
  EXPECT_THAT(plan.out, HasSubstr("  needed    sfm "));
  EXPECT_THAT(plan.out, HasSubstr("  left out  sparse_depth*"));
  EXPECT_THAT(plan.out, HasSubstr("nothing measured yet: forced by an option\n"));
  EXPECT_THAT(plan.out, HasSubstr("  open      refinement* "));
  EXPECT_THAT(plan.out, HasSubstr("  * --need and --leave-out decide otherwise\n"));
  std::istringstream lines(plan.out);
  for (std::string line; std::getline(lines, line);) {
    if (!line.starts_with("  needed") && !line.starts_with("  left out") && !line.starts_with("  open")) continue;
    EXPECT_LE(line.size(), 130u) << line;  // 120 characters, some of several bytes
  }
  EXPECT_EQ(Nrff({"plan", Path("fox"), "--explain", "--json"}).exit_code, 2);
}

}  // namespace
}  // namespace nrff
