// Bundle refinement: derivatives, recovery, statistics, gauge, and what it refuses or names.
#include "sfm/bundle_refinement.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <limits>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "sfm/bundle_problem.h"
#include "tests/bundle_fixture.h"
#include "tests/program.h"
#include "tests/temporary_directory.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;
using Eigen::Quaterniond;
using Eigen::Vector3d;
using testing::HasSubstr;
using testing::IsEmpty;

const ColmapCamera kRadial{1, CameraModel::kRadial, 640, 480, {400, 318, 243, -0.1, 0.02}};

// Central differences, extrapolated to steps of no length [Ridders82].
Eigen::MatrixXd Differences(const ceres::CostFunction& cost, std::vector<std::vector<double>> blocks, size_t block) {
  Eigen::MatrixXd derivatives(2, blocks[block].size());
  for (size_t i = 0; i < blocks[block].size(); ++i) {
    double& value = blocks[block][i];
    const double at = value, step = 1e-3 * std::max(std::abs(at), 0.1);
    const auto difference = [&](double h) {
      Eigen::Vector2d residual[2];
      for (const int side : {0, 1}) {
        value = side == 0 ? at - h : at + h;
        std::vector<const double*> values;
        values.reserve(blocks.size());
        for (const std::vector<double>& b : blocks) values.push_back(b.data());
        cost.Evaluate(values.data(), residual[side].data(), nullptr);
      }
      value = at;
      return Eigen::Vector2d((residual[1] - residual[0]) / (2 * h));
    };
    derivatives.col(Eigen::Index(i)) = (4 * difference(step / 2) - difference(step)) / 3;
  }
  return derivatives;
}

TEST(ReprojectionCost, DerivativesOfEveryModelAgreeWithExtrapolatedDifferences) {
  const Quaterniond rotation = Quaterniond(0.9, 0.1, -0.2, 0.3).normalized();
  const Vector3d center(0.3, -0.2, 0.1);
  for (const ColmapCamera& camera : CamerasOfAllModels()) {
    for (const Vector3d& in_camera : {Vector3d(0.3, -0.4, 1), Vector3d(1.2, 0.9, 2), Vector3d(2e-5, 1e-5, 1)}) {
      const Vector3d point = rotation.conjugate() * in_camera + center;
      const auto cost = ReprojectionCost(camera.model, {300, 200});
      const std::vector<std::vector<double>> blocks = {{rotation.coeffs().begin(), rotation.coeffs().end()},
                                                       {center.begin(), center.end()},
                                                       {point.begin(), point.end()},
                                                       camera.params};
      for (size_t block = 0; block < blocks.size(); ++block) {
        Eigen::Matrix<double, 2, Eigen::Dynamic, Eigen::RowMajor> jacobian(2, blocks[block].size());
        const double* values[] = {blocks[0].data(), blocks[1].data(), blocks[2].data(), blocks[3].data()};
        double* jacobians[] = {nullptr, nullptr, nullptr, nullptr};
        jacobians[block] = jacobian.data();
        Eigen::Vector2d residual;
        ASSERT_TRUE(cost->Evaluate(values, residual.data(), jacobians));
        const Eigen::MatrixXd expected = Differences(*cost, blocks, block);
        EXPECT_LT((jacobian - expected).norm(), 1e-9 * expected.norm())
            << CameraModelName(camera.model) << " block " << block << "\n"
            << jacobian << "\n"
            << expected;
      }
    }
  }
}

TEST(ReprojectionCost, IsTheLensesOwnProjection) {
  for (const ColmapCamera& camera : CamerasOfAllModels()) {
    BundleCertificate certificate;
    const Bundle bundle = SelectBundle(Ring(camera), certificate);
    for (const Bundle::Observation& observation : bundle.observations) {
      EXPECT_LT(Residual(bundle, observation).norm(), 1e-10) << CameraModelName(camera.model);
    }
  }
}

TEST(BundleRefinement, RecoversAPerturbedSceneThroughEveryLens) {
  for (const ColmapCamera& camera : CamerasOfAllModels()) {
    SCOPED_TRACE(CameraModelName(camera.model));
    const ColmapModel truth = Ring(camera);
    const ColmapModel start = Perturbed(truth, 0.005);
    ASSERT_GT(Compare(start, truth).position, 1e-3);
    const auto [model, certificate] = RefineBundle(start, {});
    EXPECT_TRUE(certificate.accepted) << certificate.reason;
    EXPECT_TRUE(certificate.converged);
    EXPECT_THAT(certificate.held, IsEmpty());
    const ModelErrors errors = Compare(model, truth);
    EXPECT_LT(errors.position, 1e-9);
    EXPECT_LT(errors.point, 1e-9);
    EXPECT_LT(errors.rotation, 1e-9);
    EXPECT_LT(errors.intrinsics, 1e-9);
    EXPECT_LT(certificate.after.mean_px, 1e-9);
    EXPECT_GT(certificate.before.mean_px, 1);
  }
}

// Residuals of N coordinates about a fit of p parameters have the variance σ²(1 − p/N), and errors over the
// covariance's deviations are of size 1.
TEST(BundleRefinement, NoiseLeavesWhatItsRedundancyAndCovariancesSay) {
  constexpr double kSigma_px = 0.5;
  const ColmapModel truth = Ring(kRadial, 16, 300);
  double squares = 0, n_squares = 0, expected = 0;
  double normalised = 0;
  int n_normalised = 0;
  for (unsigned seed = 0; seed < 6; ++seed) {
    ColmapModel start = truth;
    AddNoise(start, kSigma_px, seed);
    BundleOptions options;
    options.loss_scale_px = 100;  // squares, to the noise
    const auto [model, certificate] = RefineBundle(start, options);
    ASSERT_TRUE(certificate.accepted) << certificate.reason;
    EXPECT_TRUE(certificate.converged);
    EXPECT_LT(*certificate.remaining, 0.01);
    EXPECT_NEAR(certificate.deviation_px, kSigma_px, 0.02);
    const double n = 2 * double(certificate.n_observations);
    const double p = 3 * double(certificate.n_points) + 6 * double(model.images.size()) - 7 + 5;
    squares += 2 * certificate.cost_after;
    n_squares += n;
    expected += kSigma_px * kSigma_px * (n - p);
    // The gauge is the start's: the anchor's true pose and the true baseline, which noise in observations left.
    for (const PoseCovariance& pose : certificate.covariances) {
      if (pose.image == certificate.components[0].anchor || pose.image == certificate.components[0].partner) continue;
      const Vector3d error = model.images.at(pose.image).Center() - truth.images.at(pose.image).Center();
      normalised += error.dot(pose.position.inverse() * error);
      n_normalised += 3;
      const Eigen::AngleAxisd turn(model.images.at(pose.image).rotation *
                                   truth.images.at(pose.image).rotation.conjugate());
      const Vector3d angles = turn.angle() * turn.axis();
      normalised += angles.dot(pose.rotation.inverse() * angles);
      n_normalised += 3;
    }
  }
  EXPECT_NEAR(squares / expected, 1, 4 * std::sqrt(2 / n_squares) + 0.005);
  // Images share the gauge's error, so that a seed's are far from independent.
  EXPECT_GT(normalised / n_normalised, 0.5);
  EXPECT_LT(normalised / n_normalised, 2);
}

TEST(BundleRefinement, AFifthOfOutliersDoesNotPullItAlong) {
  const ColmapModel truth = Ring(kRadial, 16, 300);
  ColmapModel start = Perturbed(truth, 0.002);
  AddNoise(start, 0.5, 1);
  const ColmapModel clean = RefineBundle(start, {}).model;
  std::mt19937 random(2);
  std::uniform_real_distribution<double> x(0, 640), y(0, 480);
  for (auto& [id, image] : start.images) {
    for (ColmapObservation& observation : image.observations) {
      if (random() % 5 == 0) observation = {x(random), y(random), observation.point_id};
    }
  }
  const auto [model, certificate] = RefineBundle(start, {});
  EXPECT_TRUE(certificate.accepted) << certificate.reason;
  const ModelErrors without = Compare(clean, truth), with = Compare(model, truth);
  EXPECT_LT(with.position, 2 * without.position);
  EXPECT_LT(with.rotation, 2 * without.rotation);
  BundleOptions squares;
  squares.loss_scale_px = 1e4;
  EXPECT_GT(Compare(RefineBundle(start, squares).model, truth).position, 5 * without.position);
}

TEST(BundleRefinement, KeepsTheAnchorAndTheBaseline) {
  const ColmapModel start = Perturbed(Ring(kRadial), 0.005);
  const auto [model, certificate] = RefineBundle(start, {});
  ASSERT_TRUE(certificate.accepted);
  const uint32_t anchor = certificate.components[0].anchor, partner = certificate.components[0].partner;
  EXPECT_EQ(model.images.at(anchor).rotation.coeffs(), start.images.at(anchor).rotation.coeffs());
  EXPECT_EQ(model.images.at(anchor).translation, start.images.at(anchor).translation);
  const auto baseline = [&](const ColmapModel& m) {
    return (m.images.at(anchor).Center() - m.images.at(partner).Center()).norm();
  };
  EXPECT_NEAR(baseline(model), baseline(start), 1e-14 * baseline(start) * 10);
  EXPECT_EQ(certificate.covariances[anchor - 1].PositionDeviation(), 0);
  EXPECT_GT((model.images.at(partner).Center() - start.images.at(partner).Center()).norm(), 1e-4);
}

TEST(BundleRefinement, ImagesOfACameraShareItsLensAndOthersDoNot) {
  ColmapModel truth = Ring(kRadial);
  truth.cameras[2] = {2, CameraModel::kOpenCVFisheye, 640, 480, {300, 305, 318, 243, -0.02, 0.01, -0.004, 0.001}};
  truth.cameras[9] = kRadial;  // of no image
  for (auto& [id, image] : truth.images) image.camera_id = id % 2 == 0 ? 2 : 1;
  Observe(truth);
  ColmapModel start = Perturbed(truth, 0.004);
  const auto [model, certificate] = RefineBundle(start, {});
  EXPECT_TRUE(certificate.accepted) << certificate.reason;
  EXPECT_EQ(model.cameras.at(9).params, start.cameras.at(9).params);
  start.cameras[9] = truth.cameras[9];
  ColmapModel compared = model;
  compared.cameras[9] = truth.cameras[9];
  EXPECT_LT(Compare(compared, truth).intrinsics, 1e-9);
  EXPECT_LT(Compare(compared, truth).position, 1e-9);
}

TEST(BundleRefinement, GivesTheSameBitsTwiceWithOneThread) {
  ColmapModel start = Perturbed(Ring(kRadial), 0.005);
  AddNoise(start, 1, 5);
  const TemporaryDirectory directory;
  for (const char* name : {"a", "b"}) {
    fs::create_directories(directory.path() / name);
    WriteColmapBinary(RefineBundle(start, {}).model, directory.path() / name);
  }
  EXPECT_EQ(HashTree(directory.path() / "a"), HashTree(directory.path() / "b"));
}

TEST(BundleRefinement, AModelAtItsMinimumComesBackAsItWas) {
  ColmapModel start = Perturbed(Ring(kRadial), 0.001);
  AddNoise(start, 0.5, 5);
  ColmapModel once = RefineBundle(start, {}).model;
  const auto [twice, certificate] = RefineBundle(once, {});
  EXPECT_LT(Compare(twice, once).position, 1e-7);
  EXPECT_LE(certificate.cost_after, certificate.cost_before);
}

TEST(BundleRefinement, WhatIsNotFiniteIsRefusedByName) {
  const auto refusal = [](auto&& damage) -> std::string {
    ColmapModel model = Ring(kRadial, 4, 20);
    damage(model);
    try {
      RefineBundle(model, {});
      return "accepted";
    } catch (const Error& error) {
      EXPECT_EQ(error.code(), ExitCode::kInput);
      return error.what();
    }
  };
  constexpr double kNan = std::numeric_limits<double>::quiet_NaN(), kInf = std::numeric_limits<double>::infinity();
  EXPECT_THAT(refusal([](ColmapModel& m) { m.images[3].translation.x() = kNan; }), HasSubstr("photo3.jpg"));
  EXPECT_THAT(refusal([](ColmapModel& m) { m.images[2].rotation.coeffs().setZero(); }), HasSubstr("photo2.jpg"));
  EXPECT_THAT(refusal([](ColmapModel& m) { m.images[1].observations[4].y = kNan; }),
              HasSubstr("Observation 4 of image photo1.jpg"));
  EXPECT_THAT(refusal([](ColmapModel& m) { m.points[7].position.z() = kInf; }), HasSubstr("point 7"));
  EXPECT_THAT(refusal([](ColmapModel& m) { m.cameras[1].params[3] = kInf; }), HasSubstr("camera 1"));
  EXPECT_THAT(refusal([](ColmapModel& m) { m.points[5].track.emplace_back(77, 0); }), HasSubstr("track of point 5"));
}

// What a refused model says, checking that it came back untouched.
std::string Degeneracy(const ColmapModel& model) {
  const auto [same, certificate] = RefineBundle(model, {});
  EXPECT_FALSE(certificate.accepted);
  EXPECT_EQ(certificate.reason, certificate.degeneracy.value_or("none named"));
  for (const auto& [id, image] : model.images) EXPECT_EQ(same.images.at(id).translation, image.translation);
  for (const auto& [id, point] : model.points) EXPECT_EQ(same.points.at(id).position, point.position);
  return certificate.reason;
}

TEST(BundleDegeneracy, ARotatingCameraHasNoBaseline) {
  ColmapModel model;
  model.cameras[1] = kRadial;
  for (int i = 0; i < 8; ++i)
    AddImage(model, 1, LookingAt({1, 2, 3}, {5, 2 + 0.3 * i, 3 + 0.1 * i}, 0.2 * i), {1, 2, 3});
  AddPoints(model, PointsInBall(300, 20, 4));
  Observe(model);
  EXPECT_THAT(Degeneracy(model), HasSubstr("rotation only: all 8 images"));
  // As SfM would have it: centres that are anywhere near, points as far as their noise allows.
  ColmapModel estimated = model;
  std::mt19937 random(4);
  for (auto& [id, image] : estimated.images) {
    image.translation = -(image.rotation * Vector3d(image.Center() + 0.01 * NormalVector(random)));
  }
  AddNoise(estimated, 0.5, 3);
  EXPECT_THAT(Degeneracy(estimated), HasSubstr("rotation only"));
}

TEST(BundleDegeneracy, PointsAtOnePlaceFixNoPose) {
  ColmapModel model = Ring(kRadial);
  for (auto& [id, point] : model.points) point.position = {0.1, 0.2, 0.3};
  Observe(model);
  EXPECT_THAT(Degeneracy(model), HasSubstr("all points at one place"));
}

TEST(BundleDegeneracy, OneImageIsNamed) {
  ColmapModel model = Ring(kRadial, 1);
  EXPECT_THAT(Degeneracy(model), HasSubstr("one image only"));
}

// Cameras that look straight at a plane: their height and focal length cannot be told apart, nor their place and
// principal point.
TEST(BundleDegeneracy, APlaneSeenSquareHoldsTheFocalLength) {
  ColmapModel truth;
  truth.cameras[1] = {1, CameraModel::kSimplePinhole, 640, 480, {400, 320, 240}};
  for (int i = 0; i < 9; ++i) {
    const int column = i % 3, row = i / 3;
    const Vector3d center(0.7 * column, 0.6 * row, -4 + 0.2 * i);
    AddImage(truth, 1, Eigen::Matrix3d(Eigen::AngleAxisd(0.1 * i, Vector3d::UnitZ())), center);
  }
  std::vector<Vector3d> points = PointsInBall(150, 2, 4);
  for (Vector3d& point : points) point.z() = 0;
  AddPoints(truth, points);
  Observe(truth);
  ColmapModel start = truth;
  std::mt19937 random(4);
  for (auto& [id, point] : start.points) point.position += 0.01 * NormalVector(random);
  const auto [model, certificate] = RefineBundle(start, {});
  EXPECT_TRUE(certificate.accepted) << certificate.reason;
  EXPECT_THAT(certificate.held, testing::ElementsAre("principal point of camera 1", "focal length of camera 1"));
  ASSERT_TRUE(certificate.degeneracy);
  EXPECT_THAT(*certificate.degeneracy, HasSubstr("the points lie on a plane"));
  EXPECT_EQ(model.cameras.at(1).params[0], 400);
  EXPECT_LT(Compare(model, truth).position, 1e-9);
  // The same plane from all sides fixes it.
  ColmapModel tilted;
  tilted.cameras[1] = truth.cameras[1];
  for (int i = 0; i < 9; ++i) {
    const Vector3d center(3 * std::cos(0.7 * i), 3 * std::sin(0.7 * i), -3);
    AddImage(tilted, 1, LookingAt(center, {0, 0, 0}, i), center);
  }
  AddPoints(tilted, points);
  Observe(tilted);
  EXPECT_THAT(RefineBundle(Perturbed(tilted, 0.002), {}).certificate.held, IsEmpty());
}

std::vector<std::string> Structure(const ColmapModel& model) { return RefineBundle(model, {}).certificate.structure; }

// Translation alone leaves x = f X / (Z − t) as it is for f → s f, X → X / s: the focal length and the scene's width
// are one unknown.
TEST(BundleDegeneracy, ForwardMotionIsNamedAndHoldsTheFocalLength) {
  ColmapModel truth;
  truth.cameras[1] = {1, CameraModel::kSimplePinhole, 640, 480, {400, 320, 240}};
  for (int i = 0; i < 9; ++i) AddImage(truth, 1, Eigen::Matrix3d::Identity(), {0, 0, 0.4 * i});
  std::vector<Vector3d> points = PointsInBall(300, 4, 4);
  for (Vector3d& point : points) point.z() += 10;
  AddPoints(truth, points);
  Observe(truth);
  ColmapModel noisy = truth;
  AddNoise(noisy, 0.3, 5);
  for (const ColmapModel& start : {Perturbed(truth, 1e-4), noisy}) {
    const BundleCertificate certificate = RefineBundle(start, {}).certificate;
    EXPECT_THAT(certificate.held, testing::Contains("focal length of camera 1"));
    ASSERT_TRUE(certificate.degeneracy);
    EXPECT_THAT(*certificate.degeneracy, HasSubstr("forward motion: the cameras move along their viewing direction"));
    EXPECT_THAT(certificate.structure, testing::Contains(HasSubstr("no turning")));
  }
}

TEST(BundleDegeneracy, ShapesAreNamedWhereTheyAreAndNowhereElse) {
  EXPECT_THAT(Structure(Ring(kRadial)), IsEmpty());
  // Sideways along a line, looking across it: no forward motion; turning about the axis is some.
  const auto along = [](const Vector3d& step, double roll, double aside) {
    ColmapModel model;
    model.cameras[1] = {1, CameraModel::kSimplePinhole, 640, 480, {400, 320, 240}};
    for (int i = 0; i < 10; ++i) {
      const Vector3d center = (i - 5) * step + aside * Vector3d(i % 2, i / 2 % 2, 0);
      AddImage(model, 1, Eigen::Matrix3d(Eigen::AngleAxisd(roll * i, Vector3d::UnitZ())), center);
    }
    std::vector<Vector3d> points = PointsInBall(300, 4, 4);
    for (Vector3d& point : points) point.z() += 10;
    AddPoints(model, points);
    Observe(model);
    return Structure(Perturbed(model, 1e-4));
  };
  EXPECT_THAT(along({0.3, 0, 0}, 0, 0), testing::ElementsAre(HasSubstr("no turning")));
  EXPECT_THAT(along({0, 0, 0.3}, 0.1, 0), testing::ElementsAre(HasSubstr("forward motion")));
  EXPECT_THAT(along({0, 0, 0.3}, 0.1, 0.5), IsEmpty());  // zigzag
}

// A wall as SfM finds it: most points on it but for noise, some wrong ones anywhere.
TEST(BundleDegeneracy, APlaneIsNamedThroughNoiseAndOutliers) {
  const auto seen = [](double bump, double share_off) {
    ColmapModel model;
    model.cameras[1] = {1, CameraModel::kSimplePinhole, 640, 480, {400, 320, 240}};
    for (int i = 0; i < 9; ++i) {
      const Vector3d center(3 * std::cos(0.7 * i), 3 * std::sin(0.7 * i), -3);
      AddImage(model, 1, LookingAt(center, {0, 0, 0}, i), center);
    }
    std::vector<Vector3d> points = PointsInBall(400, 2, 4);
    for (size_t i = 0; i < points.size(); ++i) points[i].z() *= double(i) < share_off * 400 ? 0.5 : bump;
    AddPoints(model, points);
    Observe(model);
    AddNoise(model, 0.3, 6);
    return Structure(model);
  };
  EXPECT_THAT(seen(0.002, 0.05), testing::ElementsAre(HasSubstr("planar")));
  EXPECT_THAT(seen(0.002, 0.3), IsEmpty());
  EXPECT_THAT(seen(0.1, 0), IsEmpty());
}

TEST(BundleDegeneracy, ImagesThatTooLittleTiesToTheRestAreNamed) {
  // Two halves that share one point: each could turn and grow about it.
  ColmapModel model = Ring(kRadial);
  model.points[10].position = {0, 0, 0};
  Observe(model);
  for (auto& [id, point] : model.points) {
    std::erase_if(point.track, [shared = id == 10, half = id % 2](const auto& element) {
      return !shared && element.first % 2 != half;
    });
  }
  ASSERT_EQ(model.points.at(10).track.size(), model.images.size());
  EXPECT_THAT(Degeneracy(model), HasSubstr("poses that the points do not fix: of photo"));
}

TEST(BundleComponents, EachHasItsOwnGauge) {
  const ColmapModel truth = Ring(kRadial, 16, 300);
  ColmapModel start = Perturbed(truth, 0.003);
  for (auto& [id, point] : start.points) {
    std::erase_if(point.track, [half = id % 2](const auto& element) { return element.first % 2 != half; });
  }
  const auto [model, certificate] = RefineBundle(start, {});
  EXPECT_TRUE(certificate.accepted) << certificate.reason;
  ASSERT_EQ(certificate.components.size(), 2);
  for (const BundleComponent& component : certificate.components) {
    EXPECT_EQ(component.images.size(), 8);
    EXPECT_EQ(model.images.at(component.anchor).translation, start.images.at(component.anchor).translation);
    const auto part = [&](ColmapModel whole) {
      std::erase_if(whole.images, [&](const auto& image) { return image.first % 2 != component.anchor % 2; });
      std::erase_if(whole.points, [&](const auto& point) { return point.first % 2 != component.anchor % 2; });
      return whole;
    };
    EXPECT_LT(Compare(part(model), part(truth)).position, 1e-9);
  }
}

TEST(BundleSelection, WhatCannotBeUsedIsLeftOutAndCounted) {
  ColmapModel model = Ring(kRadial, 8, 100);
  model.points[3].track.resize(1);
  const ColmapImage& image = model.images.at(1);
  const Vector3d forward = image.rotation.conjugate() * Vector3d::UnitZ();
  model.points[5].position = image.Center() - forward;  // behind photo1, still in front of those across
  const size_t n_behind =
      size_t(std::count_if(model.points[5].track.begin(), model.points[5].track.end(), [&](auto& e) {
        const ColmapImage& other = model.images.at(e.first);
        return (other.rotation * (model.points[5].position - other.Center())).z() <= 0;
      }));
  AddImage(model, 1, Eigen::Matrix3d::Identity(), {0, 0, 9});  // sees nothing
  const auto [refined, certificate] = RefineBundle(model, {});
  EXPECT_THAT(certificate.points_left_out, testing::Contains(3));
  EXPECT_THAT(certificate.images_left_out, testing::ElementsAre("photo9.jpg"));
  EXPECT_GT(n_behind, 0);
  EXPECT_EQ(certificate.n_behind, n_behind);
  EXPECT_EQ(certificate.n_behind_after, 0);
  size_t n_points = 0, n_observations = 0;
  for (size_t n = 0; n < certificate.track_lengths.size(); ++n) {
    n_points += certificate.track_lengths[n];
    n_observations += n * certificate.track_lengths[n];
  }
  EXPECT_EQ(n_points, certificate.n_points);
  EXPECT_EQ(n_observations, certificate.n_observations);
  // r (1 + k r²) folds at r = 1/√(−3k), here 0.58: before some of the points.
  ColmapModel folded = Ring(kRadial, 8, 100);
  folded.cameras[1].params = {400, 318, 243, -1, 0};
  EXPECT_GT(RefineBundle(folded, {}).certificate.n_beyond_lens, 0);
}

TEST(RefineCommand, WritesAModelThatComparesAndACertificate) {
  const TemporaryDirectory directory;
  const fs::path in = directory.path() / "in", out = directory.path() / "out";
  const ColmapModel truth = Ring(kRadial);
  fs::create_directories(in);
  WriteColmapBinary(Perturbed(truth, 0.005), in);
  const ProgramResult run = RunProgram({"nrff-pose", "refine", "--model", in.string(), "--out", out.string()});
  ASSERT_EQ(run.exit_code, 0) << run.err;
  EXPECT_LT(Compare(ReadColmapModel(FolderOfModel(out)), truth).position, 1e-8);
  const Json certificate = ReadJson(out / kRefinementName);
  EXPECT_EQ(certificate["accepted"], true);
  EXPECT_EQ(certificate["degeneracy"], nullptr);
  EXPECT_EQ(certificate["images"].size(), 12);
  EXPECT_EQ(certificate["weakest_images"].size(), 5);
  const ProgramResult help = RunProgram({"nrff-pose", "refine", "--help"});
  std::istringstream lines(help.out);
  int n_lines = 0;
  for (std::string line; std::getline(lines, line); ++n_lines) EXPECT_LE(line.size(), 80) << line;
  EXPECT_LE(n_lines, 40);
}

}  // namespace
}  // namespace nrff
