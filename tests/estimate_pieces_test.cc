// Poses of captures that fall into pieces.
#include <algorithm>
#include <functional>
#include <numeric>

#include "sfm/pieces.h"
#include "tests/estimate_fixture.h"

namespace nrff {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;
using ::testing::Not;

// 24 photos that all look the same: each is paired with the first ten and the next three, so that those of 10 to 22
// have not been matched with 23.
class EstimateOfPieces : public Estimate {
 protected:
  void SetUp() override {
    Estimate::SetUp();
    capture_ = MakeCapture(dir_.path() / "photos", 24, false);
    SaveCapture(capture_, ingest_);
    AddModel(0, {10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22});
    AddModel(1, {0, 1, 2, 3, 4, 5, 6, 7, 8, 9});
    std::vector<int> all(24);
    std::iota(all.begin(), all.end(), 0);
    AddModel(0, all, "joined");
    options_.exhaustive = false;
  }
  size_t NumMapperCalls() {
    size_t n = 0;
    const std::string calls = Calls();
    for (size_t at = 0; (at = calls.find("mapper ", at)) != std::string::npos; ++at) ++n;
    return n;
  }

  EstimateOptions options_;
};

TEST_F(EstimateOfPieces, BecomeOneByPairsBetweenThem) {
  MakeDatabase(100);
  const Manifest manifest = Run(options_);
  EXPECT_EQ(manifest.facts.at("n_registered"), 24);
  EXPECT_EQ(manifest.facts.at("n_models"), 1);
  ASSERT_EQ(manifest.facts.at("attempts").size(), 1u);
  EXPECT_EQ(NumMapperCalls(), 2u);
}

TEST_F(EstimateOfPieces, PhotosTakenNearEachOtherArePairedToo) {
  MakeDatabase(100);
  const Manifest alike = Run(options_);
  EXPECT_FALSE(Decided(alike, "gps_pairs"));
  options_.gps_pairs = true;
  EXPECT_THROW(Run(options_), Error);
  options_.gps_pairs.reset();
  for (int i = 0; i < 24; ++i) capture_.images[size_t(i)].info.gps = {{50, 0.001 * (i * 7 % 24), {}}};
  SaveCapture(capture_, ingest_);
  const Manifest near = Run(options_);
  EXPECT_TRUE(Decided(near, "gps_pairs"));
  options_.gps_pairs = false;
  EXPECT_EQ(Run(options_).facts.at("attempts")[0].at("n_pairs"), alike.facts.at("attempts")[0].at("n_pairs"));
  options_.gps_pairs.reset();
  EXPECT_GT(near.facts.at("attempts")[0].at("n_pairs"), alike.facts.at("attempts")[0].at("n_pairs"));
  for (CaptureImage& photo : capture_.images) photo.info.gps->longitude_deg /= 1000;  // a few metres: errors
  SaveCapture(capture_, ingest_);
  EXPECT_FALSE(Decided(Run(options_), "gps_pairs"));
}

TEST_F(EstimateOfPieces, ThatDoNotMatchAreNotMappedAgain) {
  MakeDatabase(0);
  const Manifest manifest = Run(options_);
  EXPECT_EQ(manifest.facts.at("n_registered"), 13);
  EXPECT_EQ(manifest.facts.at("n_models"), 2);
  EXPECT_EQ(NumMapperCalls(), manifest.facts.at("attempts").size());
}

// Photos match where they are of the same group, whose last photo is given.
std::function<int(int, int)> WithinGroups(std::vector<int> ends, int between = 0) {
  return [ends, between](int a, int b) {
    const auto group = [&](int i) { return std::lower_bound(ends.begin(), ends.end(), i) - ends.begin(); };
    return group(a) == group(b) ? 200 : between;
  };
}

TEST_F(Estimate, OfTwoCapturesInAFolderTheLargerGoesOn) {
  AddModel(0, {5, 6, 7});
  AddModel(1, {0, 1, 2, 3, 4});
  MakeDatabase(WithinGroups({4, 7}));
  const Manifest manifest = Run();
  EXPECT_EQ(manifest.facts.at("n_registered"), 5);
  EXPECT_EQ(manifest.facts.at("attempts").size(), 1u);
  EXPECT_FALSE(Decided(manifest, "second_attempt"));
  const Json& groups = manifest.facts.at("groups");
  ASSERT_EQ(groups.size(), 2u);
  EXPECT_EQ(groups[1], (Json{{"n_images", 3}, {"n_points", 40}, {"photos", "photo 5.png to photo 7.png"}}));
  EXPECT_THAT(manifest.facts.at("groups_advice").get<std::string>(),
              AllOf(HasSubstr("No photo of one group matches any of another (of 15 pairs tried)"),
                    HasSubstr("run each by itself"), HasSubstr("between photo 4.png and photo 5.png")));
  EXPECT_EQ(ReadFile(sfm_ / "groups" / "2.txt"), "photo 5.png\nphoto 6.png\nphoto 7.png\n");
  // Chance matches do not make one scene of them; pairs that hold could, with more features.
  MakeDatabase(WithinGroups({4, 7}, 20));
  const Manifest chance = Run();
  EXPECT_EQ(chance.facts.at("attempts").size(), 1u);
  EXPECT_THAT(chance.facts.at("groups_advice").get<std::string>(), HasSubstr("no pair has the 30 matches"));
  MakeDatabase(WithinGroups({4, 7}, 40));
  const Manifest linked = Run();
  EXPECT_EQ(linked.facts.at("attempts").size(), 2u);
  EXPECT_TRUE(Decided(linked, "second_attempt"));
  EstimateOptions once;
  once.second_attempt = false;
  EXPECT_EQ(Run(once).facts.at("attempts").size(), 1u);
  EXPECT_THAT(linked.facts.at("groups_advice").get<std::string>(), HasSubstr("15 pairs of 15 pairs tried may hold"));
}

TEST_F(Estimate, GroupsOfWhichNoneHasHalfThePhotosAreAnErrorThatNamesThem) {
  capture_ = MakeCapture(dir_.path() / "photos", 12, false);
  SaveCapture(capture_, ingest_);
  AddModel(0, {0, 1, 2, 3, 4});
  AddModel(1, {4, 5, 6, 7});  // one of them is in the larger
  AddModel(2, {9, 10, 11});
  MakeDatabase(WithinGroups({4, 7, 11}));
  ExpectError(ExitCode::kInput,
              AllOf(HasSubstr("only 5 of 12 photos could be placed together: the photos fall into 3 groups"),
                    HasSubstr("5 photos with 40 points (photo 0.png to photo 4.png)"), HasSubstr("1 photo in none"),
                    HasSubstr("groups/1.txt"), Not(HasSubstr("overlap too little"))));
  EXPECT_EQ(ReadFile(dir_.path() / "sfm.partial" / "groups" / "2.txt"), "photo 5.png\nphoto 6.png\nphoto 7.png\n");
}

TEST_F(Estimate, GroupsInFoldersOfTheirOwnAreToBeRunFromThere) {
  for (size_t i = 0; i < capture_.images.size(); ++i) {
    CaptureImage& photo = capture_.images[i];
    const fs::path file = fs::path(i < 5 ? "a" : "b") / photo.path;
    fs::create_directories(capture_.root / file.parent_path());
    fs::rename(capture_.root / photo.path, capture_.root / file);
    photo.path = file;
  }
  SaveCapture(capture_, ingest_);
  AddModel(0, {0, 1, 2, 3, 4});
  AddModel(1, {5, 6, 7});
  MakeDatabase(WithinGroups({4, 7}));
  EXPECT_THAT(Run().facts.at("groups_advice").get<std::string>(),
              HasSubstr("nrff run " + (capture_.root / "a").native() + ", nrff run " + (capture_.root / "b").native()));
}

TEST_F(Estimate, GroupsOfFramesAreInNoFolderThatCouldBeRun) {
  Pieces pieces;
  pieces.pieces = {{{0, 1, 2, 3, 4}, 10}, {{5, 6, 7}, 10}};
  for (size_t i = 0; i < capture_.images.size(); ++i) capture_.images[i].path = fs::path(i < 5 ? "a" : "b") / "x.jpg";
  EXPECT_THAT(AdviseOnPieces(capture_, pieces, "groups"), HasSubstr("nrff run"));
  for (CaptureImage& photo : capture_.images) photo.extracted = true;
  EXPECT_THAT(AdviseOnPieces(capture_, pieces, "groups"),
              AllOf(Not(HasSubstr("nrff run")), HasSubstr("groups/1.txt and so on list the photos")));
}

}  // namespace
}  // namespace nrff
