// What a capture does not need: facts and the decisions that follow, on either side of each bound.
#include "pipeline/needs.h"

#include <gtest/gtest.h>

namespace nrff {
namespace {

TEST(Needs, PairsAreChosenWhereThereAreMany) {
  EXPECT_TRUE(needs::ExhaustiveMatching(32, false).needed);
  EXPECT_FALSE(needs::ExhaustiveMatching(33, true).needed);
  EXPECT_TRUE(needs::GpsPairs(false, 20).needed);
  EXPECT_FALSE(needs::GpsPairs(false, 19.9).needed);
  EXPECT_FALSE(needs::GpsPairs(false, {}).needed);
  EXPECT_FALSE(needs::GpsPairs(true, 100).needed) << "they are among all";
}

TEST(Needs, ASecondAttemptIsMadeOfTooFewPhotosThatAreOneScene) {
  EXPECT_FALSE(needs::SecondAttempt(10, 8, 1, 8, 0).needed);
  EXPECT_TRUE(needs::SecondAttempt(10, 7, 1, 7, 0).needed);
  EXPECT_FALSE(needs::SecondAttempt(10, 5, 2, 8, 0).needed) << "two scenes";
  EXPECT_TRUE(needs::SecondAttempt(10, 5, 2, 8, 1).needed) << "a pair may hold them together";
  EXPECT_TRUE(needs::SecondAttempt(10, 4, 2, 7, 0).needed);
}

TEST(Needs, LensesAreAsRichAsPhotosNeed) {
  EXPECT_TRUE(needs::RicherLens("SIMPLE_RADIAL", 1, "RADIAL", 0.97).needed);
  EXPECT_FALSE(needs::RicherLens("SIMPLE_RADIAL", 1, "RADIAL", 0.98).needed);
  EXPECT_TRUE(needs::RicherLens("SIMPLE_RADIAL", 1, "RADIAL", 0.9, 0.91).needed);
  EXPECT_FALSE(needs::RicherLens("SIMPLE_RADIAL", 1, "RADIAL", 0.9, 0.9).needed) << "it was zoomed";
  EXPECT_TRUE(needs::Fisheye(10, 1000, 10, 1100).needed);
  EXPECT_FALSE(needs::Fisheye(10, 1000, 10, 1099).needed);
  EXPECT_FALSE(needs::Fisheye(10, 1000, 9, 2000).needed);
  EXPECT_FALSE(needs::Fisheye(0, 0, 0, 0).needed);
}

TEST(Needs, FocalLengthsAreOwnWhereThatShows) {
  EXPECT_TRUE(needs::OwnFocalLengths({1, 0.97}).needed);
  EXPECT_FALSE(needs::OwnFocalLengths({1, 0.98}).needed);
  EXPECT_FALSE(needs::OwnFocalLengths({0.1, 0.091}).needed) << "9 %, but less than 0.01 px";
  EXPECT_TRUE(needs::OwnFocalLengths({0.1, 0.08}).needed);
  EXPECT_FALSE(needs::OwnFocalLengthsUntried("few").needed);
  EXPECT_TRUE(needs::OwnFocalLengthsUntried("added", true).needed);
}

TEST(Needs, RefinementEndsWhereItCouldNotBeChecked) {
  EXPECT_TRUE(needs::Refinement(500, 500).needed);
  EXPECT_FALSE(needs::Refinement(501, 500).needed);
}

TEST(Needs, GeometryIsWhatTheCaptureSays) {
  EXPECT_FALSE(needs::Sfm(true, "transforms.json").needed);
  EXPECT_TRUE(needs::Sfm(false, "fox").needed);
  EXPECT_TRUE(needs::Undistortion(0.1).needed);
  EXPECT_FALSE(needs::Undistortion(0.099).needed);
  EXPECT_FALSE(needs::Contraction(true, false, {}).needed);
  EXPECT_FALSE(needs::Contraction(false, true, 0.5).needed);
  EXPECT_TRUE(needs::Contraction(false, false, {}).needed);
  EXPECT_TRUE(needs::Contraction(false, false, 0.02).needed);
  EXPECT_FALSE(needs::Contraction(false, false, 0.019).needed);
}

TEST(Needs, TrainingTakesWhatViewsAndPointsSettle) {
  EXPECT_TRUE(needs::FineLevels(15, false, 64).needed);
  EXPECT_FALSE(needs::FineLevels(15, false, 128).needed);
  EXPECT_TRUE(needs::FineLevels(31, false, 128).needed);
  EXPECT_FALSE(needs::FineLevels(31, false, 256).needed);
  EXPECT_TRUE(needs::FineLevels(32, false, 256).needed);
  EXPECT_TRUE(needs::FineLevels(9, true, 256).needed);
  EXPECT_TRUE(needs::SparseDepth(200, true).needed);
  EXPECT_FALSE(needs::SparseDepth(199, true).needed);
  EXPECT_FALSE(needs::SparseDepth(5000, false).needed);
  EXPECT_TRUE(needs::ExposureCorrection(0.2, true).needed);
  EXPECT_FALSE(needs::ExposureCorrection(0.19, true).needed);
  EXPECT_FALSE(needs::ExposureCorrection(0.5, false).needed);
  EXPECT_TRUE(needs::SmallModel(1, 1500, true).needed);
  EXPECT_FALSE(needs::SmallModel(1, 1499, true).needed);
  EXPECT_TRUE(needs::SmallModel(1, 700, false).needed);
  EXPECT_FALSE(needs::SmallModel(1, 699, false).needed);
}

TEST(Needs, ToolsAreLeftOutWhereTheyAreNot) {
  EXPECT_FALSE(needs::Lpips(needs::kNoLpips).needed);
  EXPECT_TRUE(needs::Lpips("vgg.onnx").needed);
  EXPECT_FALSE(needs::Cuda(false, "no GPU").needed);
}

TEST(Needs, EitherWayCanBeForcedAndSaysSo) {
  Decision decision = needs::Refinement(10, 500);
  Force(decision, {});
  EXPECT_TRUE(decision.needed);
  EXPECT_NE(decision.reason, "forced by an option");
  Force(decision, false);
  EXPECT_FALSE(decision.needed);
  EXPECT_EQ(decision.reason, "forced by an option");
  EXPECT_EQ(decision.evidence, "10 photos placed") << "what was measured stays";
}

}  // namespace
}  // namespace nrff
