#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstdlib>
#include <random>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "sfm/colmap_model.h"
#include "sfm/trajectory_errors.h"
#include "tests/temporary_directory.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;

Eigen::Vector3d RandomVector(std::mt19937& random) {
  std::normal_distribution<double> normal;
  return {normal(random), normal(random), normal(random)};
}

Eigen::Quaterniond RandomRotation(std::mt19937& random) {
  std::normal_distribution<double> normal;
  return Eigen::Quaterniond(normal(random), normal(random), normal(random), normal(random)).normalized();
}

Trajectory Random(int n, unsigned seed) {
  std::mt19937 random(seed);
  Trajectory trajectory;
  for (int i = 0; i < n; ++i) {
    trajectory.push_back({"photo" + std::to_string(1000 + i), RandomRotation(random), RandomVector(random)});
  }
  return trajectory;
}

Eigen::Matrix4d SimilarityOf(double scale, const Eigen::Quaterniond& rotation, const Eigen::Vector3d& translation) {
  Eigen::Matrix4d matrix = Eigen::Matrix4d::Identity();
  matrix.topLeftCorner<3, 3>() = scale * rotation.toRotationMatrix();
  matrix.topRightCorner<3, 1>() = translation;
  return matrix;
}

Eigen::Matrix4d Align(const Trajectory& estimated, const Trajectory& truth) {
  return AlignTrajectories(estimated, truth, MatchPoses(estimated, truth));
}

TEST(Alignment, FindsTheSimilarityWhateverItsScaleAndOrigin) {
  std::mt19937 random(3);
  for (const double scale : {1e-6, 0.3, 1.0, 1e6}) {
    for (const double offset : {0.0, 1e3}) {
      for (const int n : {3, 4, 40}) {
        const Trajectory truth = Random(n, unsigned(n));
        const Eigen::Matrix4d similarity =
            SimilarityOf(scale, RandomRotation(random), scale * offset * RandomVector(random));
        const Eigen::Matrix4d found = Align(Transformed(truth, similarity), truth);
        // The centres lost log10(offset) of their sixteen digits.
        EXPECT_LT((found * similarity - Eigen::Matrix4d::Identity()).norm(), 1e-12 * (10 + offset) * (1 + offset))
            << scale << " " << offset << " " << n;
      }
    }
  }
}

TEST(Alignment, WrongPosesDoNotPullTheOthersAlong) {
  const Trajectory truth = Random(50, 4);
  std::mt19937 random(5);
  const Eigen::Matrix4d similarity = SimilarityOf(2, RandomRotation(random), RandomVector(random));
  Trajectory estimated = Transformed(truth, similarity);
  for (int i = 0; i < 20; ++i) {  // two of five
    estimated[i].center = 10 * RandomVector(random);
    estimated[i].rotation = RandomRotation(random);
  }
  for (int i = 20; i < 50; ++i) estimated[i].center += 1e-6 * RandomVector(random);
  EXPECT_LT((Align(estimated, truth) * similarity - Eigen::Matrix4d::Identity()).norm(), 3e-6);
}

TEST(Alignment, OnALineTheCamerasRotationsDecide) {
  Trajectory truth = Random(12, 6);
  for (size_t i = 0; i < truth.size(); ++i) truth[i].center = double(i * i) * Eigen::Vector3d(1, 2, -1);
  std::mt19937 random(7);
  const Eigen::Matrix4d similarity = SimilarityOf(0.5, RandomRotation(random), RandomVector(random));
  const Eigen::Matrix4d found = Align(Transformed(truth, similarity), truth);
  // Angles to 1e-9, times how far out the centres lie.
  const double tolerance = 1e-8 * truth.back().center.norm();
  EXPECT_LT((found * similarity - Eigen::Matrix4d::Identity()).norm(), tolerance);
  const Trajectory two(truth.begin() + 3, truth.begin() + 5);
  EXPECT_LT((Align(Transformed(two, similarity), two) * similarity - Eigen::Matrix4d::Identity()).norm(), tolerance);
}

TEST(Alignment, OnALineButForNoiseTheCamerasRotationsDecide) {
  Trajectory truth = Random(30, 14), estimated;
  std::mt19937 random(15);
  for (size_t i = 0; i < truth.size(); ++i) {
    truth[i].center = double(i) * Eigen::Vector3d(1, 2, -1) + 1e-4 * RandomVector(random);
  }
  estimated = truth;
  for (TrajectoryPose& pose : estimated) pose.center += 1e-2 * RandomVector(random);
  EXPECT_LT(TrajectoryErrors(estimated, truth)["rotation_deg"]["max"], 0.2);
}

TEST(Alignment, WhereMostCamerasStandAtOnePointTheOthersTell) {
  Trajectory truth = Random(20, 16);
  for (size_t i = 0; i < 12; ++i) truth[i].center = {1, 2, 3};
  std::mt19937 random(17);
  const Eigen::Matrix4d similarity = SimilarityOf(3, RandomRotation(random), RandomVector(random));
  const Json errors = TrajectoryErrors(Transformed(truth, similarity), truth);
  EXPECT_LT(errors["position"]["max"], 1e-9);
  EXPECT_LT(errors["rotation_deg"]["max"], 1e-5);
  // An estimate that leaves cameras at one point has no direction between them.
  Trajectory collapsed = Random(6, 18);
  const Trajectory apart = collapsed;
  collapsed[1].center = collapsed[0].center;
  EXPECT_EQ(TrajectoryErrors(collapsed, apart)["relative_deg"]["direction"]["max"], 180);
}

TEST(Alignment, AMirroredWorldIsNoSimilarityButHasFiniteErrors) {
  const Trajectory truth = Random(20, 8);
  Trajectory mirrored = truth;
  for (TrajectoryPose& pose : mirrored) pose.center.x() *= -1;
  const Json errors = TrajectoryErrors(mirrored, truth);
  EXPECT_GT(errors["position"]["median"], 0.1);
  EXPECT_TRUE(std::isfinite(errors["position"]["max"].get<double>()));
}

TEST(Alignment, WhatCannotBeAlignedIsAnInputErrorThatSaysWhy) {
  const auto refusal = [](const Trajectory& estimated, const Trajectory& truth) -> std::string {
    try {
      Align(estimated, truth);
      return "accepted";
    } catch (const Error& error) {
      EXPECT_EQ(error.code(), ExitCode::kInput);
      return error.what();
    }
  };
  const Trajectory truth = Random(5, 9);
  Trajectory others = Random(4, 9), one_point = truth;
  for (TrajectoryPose& pose : others) pose.name = "other" + pose.name;
  for (TrajectoryPose& pose : one_point) pose.center = {1e7, 2, 3};
  EXPECT_THAT(refusal(others, truth), HasSubstr("Only 0 of 4 estimated poses belong to one of the 5 true ones"));
  EXPECT_THAT(refusal(one_point, truth), HasSubstr("All estimated camera centres are one point"));
  EXPECT_THAT(refusal(truth, one_point), HasSubstr("All true camera centres are one point"));
}

TEST(Matches, AreByNameThenFileNameThenOrder) {
  const Trajectory truth = Random(6, 10);
  Trajectory estimated(truth.begin() + 2, truth.end());
  EXPECT_EQ(MatchPoses(estimated, truth).by, "name");
  EXPECT_EQ(MatchPoses(estimated, truth).pairs.front(), std::pair(size_t(0), size_t(2)));
  for (TrajectoryPose& pose : estimated) pose.name = "images/" + pose.name;
  EXPECT_EQ(MatchPoses(estimated, truth).by, "file name");
  EXPECT_EQ(MatchPoses(estimated, truth).pairs.size(), 4);
  for (TrajectoryPose& pose : estimated) pose.name += "x";
  EXPECT_TRUE(MatchPoses(estimated, truth).pairs.empty());
  estimated = truth;
  for (TrajectoryPose& pose : estimated) pose.name += "x";
  EXPECT_EQ(MatchPoses(estimated, truth).by, "order");
}

TEST(TrajectoryErrors, HaveTheirClosedForms) {
  // Every camera turned by 2° about its own axis: alignment of the centres cannot take that away.
  const Trajectory truth = Random(30, 11);
  Trajectory estimated = truth;
  const Eigen::Quaterniond turn(Eigen::AngleAxisd(2 * M_PI / 180, Eigen::Vector3d::UnitZ()));
  for (TrajectoryPose& pose : estimated) pose.rotation = pose.rotation * turn;
  Json errors = TrajectoryErrors(estimated, truth);
  EXPECT_NEAR(errors["rotation_deg"]["median"], 2, 1e-6);
  EXPECT_NEAR(errors["rotation_deg"]["max"], 2, 1e-6);
  EXPECT_LT(errors["position"]["max"], 1e-9);
  EXPECT_NEAR(errors["rotation_deg"]["auc"]["5"], 1 - 2.0 / 5, 1e-6);
  EXPECT_EQ(errors["rotation_deg"]["auc"]["1"], 0);

  // Images that are missing count in the areas: 20 of 30, 190 of 435 pairs.
  estimated = Trajectory(truth.begin(), truth.begin() + 20);
  errors = TrajectoryErrors(estimated, truth);
  EXPECT_NEAR(errors["rotation_deg"]["auc"]["1"], 20.0 / 30, 1e-6);
  EXPECT_NEAR(errors["position"]["auc"]["1%"], 20.0 / 30, 1e-6);
  EXPECT_NEAR(errors["relative_deg"]["auc"]["3"], 190.0 / 435, 1e-6);
  EXPECT_EQ(errors["n_matched"], 20);

  // Relative poses need no alignment: one wrong pose among 30 is in 29 of 435 pairs.
  estimated = truth;
  estimated[7].rotation = estimated[7].rotation * Eigen::Quaterniond(Eigen::AngleAxisd(1, Eigen::Vector3d::UnitX()));
  errors = TrajectoryErrors(estimated, truth);
  EXPECT_NEAR(errors["relative_deg"]["auc"]["10"], 1 - 29.0 / 435, 1e-6);
  EXPECT_THAT(TrajectoryErrorsText(errors), HasSubstr("30 of 30 true ones estimated, matched by name"));
}

TEST(AreaUnderRecall, IsTheIntegralOfTheCurve) {
  EXPECT_DOUBLE_EQ(AreaUnderRecall({0, 0}, 5), 1);
  EXPECT_DOUBLE_EQ(AreaUnderRecall({5, 7, INFINITY}, 5), 0);
  EXPECT_DOUBLE_EQ(AreaUnderRecall({0, 2.5, 10, INFINITY}, 5), (1 + 0.5) / 4);
  EXPECT_DOUBLE_EQ(AreaUnderRecall({}, 5), 0);
}

TEST(TrajectoryFiles, LogsComeBackAsTheyWere) {
  const TemporaryDirectory directory;
  const fs::path file = directory.path() / "poses.log";
  const Trajectory truth = Random(12, 12);
  WriteTrajectoryLog(truth, file);
  const Trajectory read = ReadTrajectory(file);
  ASSERT_EQ(read.size(), truth.size());
  for (size_t i = 0; i < truth.size(); ++i) {
    EXPECT_EQ(read[i].center, truth[i].center);
    EXPECT_LT(read[i].rotation.angularDistance(truth[i].rotation), 1e-15);
  }
  EXPECT_EQ(read[11].name, "#000011");
  // Through a COLMAP model, too.
  ColmapModel model;
  model.cameras[1] = {1, CameraModel::kSimplePinhole, 10, 10, {5, 5, 5}};
  for (uint32_t id = 1; id <= truth.size(); ++id) {
    ColmapImage& image = model.images[id];
    image.id = id, image.camera_id = 1, image.name = truth[id - 1].name + ".jpg";
    image.rotation = truth[id - 1].rotation.conjugate();
    image.translation = -(image.rotation * truth[id - 1].center);
  }
  fs::create_directories(directory.path() / "sparse");
  WriteColmapBinary(model, directory.path() / "sparse");
  const Json errors = TrajectoryErrors(ReadTrajectory(directory.path() / "sparse"), truth);
  EXPECT_EQ(errors["n_matched"], 12);
  EXPECT_LT(errors["position"]["max"], 1e-10);
  EXPECT_LT(errors["rotation_deg"]["max"], 1e-5);
}

TEST(TrajectoryFiles, DamagedOnesAreInputErrorsThatNameThePlace) {
  const TemporaryDirectory directory;
  const fs::path file = directory.path() / "poses.log";
  const auto refusal = [&](const std::string& text, auto&& read) -> std::string {
    WriteFileAtomically(file, text);
    try {
      read(file);
      return "accepted";
    } catch (const Error& error) {
      EXPECT_EQ(error.code(), ExitCode::kInput);
      EXPECT_THAT(error.what(), HasSubstr("poses.log"));
      return error.what();
    }
  };
  const std::string good = "0 0 0\n1 0 0 4\n0 1 0 5\n0 0 1 6\n0 0 0 1\n";
  EXPECT_EQ(refusal(good, ReadTrajectory), "accepted");
  EXPECT_THAT(refusal("", ReadTrajectory), HasSubstr("holds no poses"));
  EXPECT_THAT(refusal(good + "1 1 0\n1 0 0", ReadTrajectory), HasSubstr("line 7: the file ends"));
  EXPECT_THAT(refusal("0 0 0\n1 0 nan 4\n", ReadTrajectory), HasSubstr("line 2: found \"nan\""));
  EXPECT_THAT(refusal("0 0 0\n2 0 0 4\n0 1 0 5\n0 0 1 6\n0 0 0 1\n", ReadTrajectory), HasSubstr("no rotation"));
  EXPECT_THAT(refusal(good + good, ReadTrajectory), HasSubstr("two poses are called #000000"));
  EXPECT_THAT(refusal("-1" + good, ReadTrajectory), HasSubstr("whole number"));
  EXPECT_THAT(refusal("1 0 0 1 0 2 0 1 0 0 1 1 0 0 0 1", ReadSimilarity), HasSubstr("is no similarity"));
  EXPECT_THAT(refusal("1 0 0 1 0 1 0 1 0 0 -1 1 0 0 0 1", ReadSimilarity), HasSubstr("is no similarity"));
  EXPECT_THAT(refusal("1 0 0 1", ReadSimilarity), HasSubstr("the file ends"));
  EXPECT_THROW(ReadTrajectory(directory.path() / "none"), Error);
}

TEST(TrajectoryFiles, FoldersOfMatricesGetTheNearestRotation) {
  const TemporaryDirectory directory;
  fs::create_directories(directory.path() / "pose");
  const fs::path first = directory.path() / "pose/0_a.txt";
  WriteFileAtomically(first, "1.01 0 0 4\n0 0.99 0 5\n0 0 1 6\n0 0 0 1\n");
  WriteFileAtomically(directory.path() / "pose/1_b.txt", "0 -1 0 1\n1 0 0 2\n0 0 1 3\n0 0 0 1\n");
  const Trajectory read = ReadTrajectory(directory.path() / "pose");
  ASSERT_EQ(read.size(), 2);
  EXPECT_EQ(read[0].name, "0_a");
  EXPECT_LT(read[0].rotation.angularDistance(Eigen::Quaterniond::Identity()), 1e-12);
  EXPECT_EQ(read[1].center, Eigen::Vector3d(1, 2, 3));
  for (const char* no_rotation : {"1 0 0 4 0 1 0 5 0 0 -1 6 0 0 0 1", "0 0 0 4 0 0 0 5 0 0 0 6 0 0 0 1"}) {
    WriteFileAtomically(first, no_rotation);
    EXPECT_THROW(ReadTrajectory(directory.path() / "pose"), Error);
  }
  WriteFileAtomically(first, "1 0 0 4\n0 1 0 5\n0 0 1 6\n0 0 0 1\n");
  EXPECT_EQ(ReadTrajectory(directory.path() / "pose/").size(), 2);
}

// Cameras around an object, each turned by 2° about its own optical axis or not at all, see a corner of the object off
// by that turn times the sine of the corner's angle from the axis.
TEST(CropVolume, SaysHowFarOffTheObjectIsSeen) {
  const TemporaryDirectory directory;
  const fs::path file = directory.path() / "Object.json";
  WriteFileAtomically(file,
                      R"({"class_name": "SelectionPolygonVolume", "version_major": 1, "version_minor": 0,
                          "orthogonal_axis": "Y", "axis_min": -0.5, "axis_max": 1.5,
                          "bounding_polygon": [[1, 7, 0], [0, 7, 1], [-1, 7, 0]]})");
  const CropVolume object = ReadCropVolume(file);
  ASSERT_EQ(object.Corners().size(), 6);
  EXPECT_EQ(object.Corners()[1], Eigen::Vector3d(0, -0.5, 1));
  EXPECT_EQ(object.Corners()[3], Eigen::Vector3d(1, 1.5, 0));

  const Trajectory truth = Random(30, 17);
  EXPECT_LT(TrajectoryErrors(truth, truth, &object)["object_deg"]["max"], 1e-5);
  EXPECT_FALSE(TrajectoryErrors(truth, truth).contains("object_deg"));
  constexpr double kTurn = 2 * M_PI / 180;
  Trajectory turned = truth;
  double most = 0;
  for (size_t i = 0; i < turned.size(); i += 3) {  // few enough for the alignment to leave them aside
    turned[i].rotation = truth[i].rotation * Eigen::AngleAxisd(kTurn, Eigen::Vector3d::UnitZ());
    for (const Eigen::Vector3d& corner : object.Corners()) {
      const Eigen::Vector3d seen = truth[i].rotation.inverse() * (corner - truth[i].center);
      const double sine = seen.head<2>().norm() / seen.norm();
      most = std::max(most, 2 * std::asin(sine * std::sin(kTurn / 2)) * 180 / M_PI);
    }
  }
  const Json errors = TrajectoryErrors(turned, truth, &object);
  EXPECT_NEAR(errors["object_deg"]["max"], most, 1e-4);
  EXPECT_THAT(TrajectoryErrorsText(errors), HasSubstr("object "));

  for (const auto& [text, told] : std::vector<std::pair<const char*, const char*>>{
           {"[", "it is no JSON"},
           {R"({"class_name": "Box"})", "it is no SelectionPolygonVolume"},
           {"[]", "it is no SelectionPolygonVolume"},
           {R"({"class_name": 3})", "it is no SelectionPolygonVolume"},
           {R"({"class_name": "SelectionPolygonVolume", "orthogonal_axis": "X", "axis_min": 0, "axis_max": 1,
                "bounding_polygon": [[0, 0, 0, 7], [1, 1, 1], [1, 2, 3]]})",
            "a corner of bounding_polygon has 4 numbers"},
           {R"({"class_name": "SelectionPolygonVolume", "orthogonal_axis": "W"})", "orthogonal_axis is 'W'"},
           {R"({"class_name": "SelectionPolygonVolume", "orthogonal_axis": "X"})", "axis_min"},
           {R"({"class_name": "SelectionPolygonVolume", "orthogonal_axis": "X", "axis_min": 1, "axis_max": 1,
                "bounding_polygon": []})",
            "axis_min is not less than axis_max"},
           {R"({"class_name": "SelectionPolygonVolume", "orthogonal_axis": "X", "axis_min": 0, "axis_max": 1,
                "bounding_polygon": [[0, 0, 0], [1, 1, 1]]})",
            "fewer than three corners"}}) {
    WriteFileAtomically(file, text);
    try {
      ReadCropVolume(file);
      ADD_FAILURE() << text;
    } catch (const Error& error) {
      EXPECT_EQ(error.code(), ExitCode::kInput);
      EXPECT_THAT(error.what(), HasSubstr(told));
      EXPECT_THAT(error.what(), HasSubstr("Object.json"));
    }
  }
}

// A .log's numbers are no photos' names, however alike they look.
TEST(TrajectoryFiles, ATrainArtifactsCorrectedCamerasAreRead) {
  const TemporaryDirectory dir;
  const auto view = [](const char* name, const char* split, double x) {
    return Json{{"id", "000001"},
                {"name", name},
                {"split", split},
                {"scene_from_camera", {0, -1, 0, x, 1, 0, 0, 2, 0, 0, 1, 3, 0, 0, 0, 1}}};
  };
  Json cameras = {{"schema_version", 1}, {"views", {view("a.jpg", "train", 1), view("b.jpg", "test", 5)}}};
  WriteJson(dir.path() / "cameras.json", cameras);
  const Trajectory read = ReadTrajectory(dir.path());
  ASSERT_EQ(read.size(), 1u);  // held-out views' are not corrected
  EXPECT_EQ(read[0].name, "a");
  EXPECT_EQ(read[0].center, Eigen::Vector3d(1, 2, 3));
  EXPECT_NEAR(read[0].rotation.toRotationMatrix()(1, 0), 1, 1e-12);
  cameras["views"][0]["scene_from_camera"][0] = 0.5;
  WriteJson(dir.path() / "cameras.json", cameras);
  try {
    ReadTrajectory(dir.path());
    FAIL() << "was read";
  } catch (const Error& error) {
    EXPECT_THAT(error.what(), HasSubstr("cameras.json: the pose of view 000001 holds no rotation"));
  }
}

TEST(TrajectoryFiles, NumbersOfALogAreNotTakenForPhotosNames) {
  const TemporaryDirectory directory;
  const Trajectory truth = Random(5, 13);
  WriteTrajectoryLog(truth, directory.path() / "poses.log");
  Trajectory photos = truth;
  for (size_t i = 0; i < photos.size(); ++i) photos[i].name = "00000" + std::to_string(i + 1);
  const Matches matches = MatchPoses(ReadTrajectory(directory.path() / "poses.log"), photos);
  EXPECT_EQ(matches.by, "order");
  EXPECT_EQ(matches.pairs.size(), 5);
}

// The trajectory and its transform that Tanks & Temples publishes for Ignatius.
TEST(TrajectoryFiles, OfTanksAndTemples) {
  const char* data = std::getenv("NRFF_DATA");
  if (data == nullptr) GTEST_SKIP() << "NRFF_DATA is not set";
  const fs::path folder = fs::path(data) / "trajectory/Ignatius";
  const Trajectory poses = ReadTrajectory(folder / "Ignatius_COLMAP_SfM.log");
  EXPECT_EQ(poses.size(), 263);
  const Eigen::Matrix4d transform = ReadSimilarity(folder / "Ignatius_trans.txt");
  const Json errors = TrajectoryErrors(poses, Transformed(poses, transform));
  EXPECT_LT(errors["position"]["max"], 1e-9);
  EXPECT_LT(errors["rotation_deg"]["max"], 1e-5);
  const auto found = errors["truth_from_estimated"].get<std::vector<double>>();
  for (int i = 0; i < 16; ++i) EXPECT_NEAR(found[i], transform(i / 4, i % 4), 1e-9) << i;
}

}  // namespace
}  // namespace nrff
