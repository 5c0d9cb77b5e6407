// The pose stage: what it writes shows the capture's world from the capture's cameras.
#include "sfm/scene_pack.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <Eigen/LU>
#include <optional>

#include "pipeline/extension.h"
#include "pipeline/scene.h"
#include "sfm/earlier_frame.h"
#include "sfm/merged_model.h"
#include "sfm/sparse_depth.h"
#include "sfm/transforms_json.h"
#include "tests/pose_fixture.h"
#include "tests/temporary_directory.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;
using ::testing::HasSubstr;

class ScenePack : public ::testing::Test {
 protected:
  void Make(int n, double k, std::vector<int> registered = {}) {
    capture_ = MakeCapture(dir_.path() / "photos", n, true);
    fs::create_directories(ingest_);
    SaveCapture(capture_, ingest_);
    std::vector<std::string> names;
    for (int i = 0; i < n; ++i) {
      if (registered.empty() || std::count(registered.begin(), registered.end(), i)) names.push_back(Id(i));
    }
    model_ = MakeModel(names, 64, 48, k);
    fs::create_directories(ingest_ / "sparse");
    WriteColmapBinary(model_, ingest_ / "sparse");
  }

  Manifest Write(const PoseOptions& options = {}) {
    ArtifactWriter artifact("pose", pose_, {}, {});
    WriteScene(ingest_, ingest_ / "sparse", options, artifact);
    artifact.Commit();
    return RequireArtifact(pose_, "pose");
  }

  void ExpectInputError(const std::string& text) {
    try {
      Write();
      FAIL();
    } catch (const Error& error) {
      EXPECT_EQ(error.code(), ExitCode::kInput);
      EXPECT_THAT(error.what(), HasSubstr(text));
    }
  }

  TemporaryDirectory dir_;
  fs::path ingest_ = dir_.path() / "ingest", pose_ = dir_.path() / "pose";
  Capture capture_;
  ColmapModel model_;
};

Eigen::Vector3d Apply(const Mat4& m, const Eigen::Vector3d& p) {
  return Eigen::Map<const Eigen::Matrix<double, 4, 4, Eigen::RowMajor>>(m.data()).topRows<3>() * p.homogeneous();
}

class ExtendedScene : public ScenePack {
 protected:
  // A scene of six photos becomes the base of one of eight on the same ring, in a world moved by `world`.
  Scene MakeExtended(bool in_its_world, const Eigen::Matrix4d& world = Eigen::Matrix4d::Identity()) {
    Make(6, 0);
    Write();
    options_.base = dir_.path() / "base";
    fs::rename(pose_, options_.base);
    earlier_ = LoadScene(options_.base);
    fs::remove(options_.base / kPackFile);  // is not kept
    Make(8, 0);
    model_ = Transformed(model_, world);
    WriteColmapBinary(model_, ingest_ / "sparse");
    WriteJson(ingest_ / kExtensionFile, {{"schema_version", kExtensionSchemaVersion}, {"frame_kept", in_its_world}});
    manifest_ = Write(options_);
    return LoadScene(pose_);
  }
  const Decision* FrameDecision() const {
    for (const Decision& decision : manifest_.decisions) {
      if (decision.feature == "frame_anew") return &decision;
    }
    return nullptr;
  }
  PoseOptions options_;
  Scene earlier_;
  Manifest manifest_;
};

TEST_F(ExtendedScene, KeepsTheFrameThatSuitsIt) {
  const Scene scene = MakeExtended(true);
  ASSERT_NE(FrameDecision(), nullptr);
  EXPECT_FALSE(FrameDecision()->needed) << FrameDecision()->evidence;
  EXPECT_EQ(scene.scene_from_world, earlier_.scene_from_world);
  EXPECT_EQ(scene.aabb_min, earlier_.aabb_min);
  EXPECT_EQ(scene.aabb_max, earlier_.aabb_max);
  EXPECT_LE(scene.near, earlier_.near);
  EXPECT_GE(scene.far, earlier_.far);
}

TEST_F(ExtendedScene, HasAFrameOfItsOwnInAnotherWorld) {
  const Scene scene = MakeExtended(false);
  EXPECT_EQ(FrameDecision(), nullptr);
  EXPECT_NE(scene.scene_from_world, earlier_.scene_from_world);
}

TEST_F(ExtendedScene, HasAFrameOfItsOwnWhereTheEarlierDoesNotSuit) {
  Eigen::Matrix4d elsewhere = Eigen::Matrix4d::Identity();
  elsewhere(0, 3) = 10;
  const Scene scene = MakeExtended(true, elsewhere);
  ASSERT_NE(FrameDecision(), nullptr);
  EXPECT_TRUE(FrameDecision()->needed);
  EXPECT_NE(scene.scene_from_world, earlier_.scene_from_world);
}

TEST(EarlierFrame, GainsReferToTheEarlierExposure) {
  EarlierFrame earlier;
  earlier.training_gains = {{"a", {1, 1, 2}}, {"b", {1, 1, 0.5}}};
  Scene scene;
  for (const char* id : {"a", "b", "c", "held out"}) {
    View& view = scene.views.emplace_back();
    view.id = id;
    view.split = view.id == "held out" ? Split::kTest : Split::kTrain;
  }
  // The third is four times as bright: the mean of all is not that of the first two.
  scene.views[0].colour_gain = {0.5, 0.5, 1};
  scene.views[1].colour_gain = {0.5, 0.5, 0.25};
  scene.views[2].colour_gain = {2, 2, 2};
  KeepExposure(earlier, scene);
  const double expected[] = {1, 1, 4, 1};
  for (size_t i = 0; i < 4; ++i) EXPECT_NEAR(scene.views[i].colour_gain[0], expected[i], 1e-12) << i;
  EXPECT_NEAR(scene.views[0].colour_gain[2], 2, 1e-12);
}

TEST_F(ScenePack, PointsProjectToWhereTheLensHadThem) {
  for (const double k : {0.0, -0.05}) {
    SCOPED_TRACE(k);
    Make(6, k);
    Write();
    const Scene scene = LoadScene(pose_);
    const ColmapModel pinhole = ReadColmapModel(pose_ / "sparse");
    ASSERT_EQ(scene.views.size(), 6u);
    size_t n_compared = 0;
    for (const View& view : scene.views) {
      const ColmapImage* image = nullptr;
      for (const auto& [id, candidate] : pinhole.images) {
        if (candidate.name == view.name) image = &candidate;
      }
      ASSERT_TRUE(image) << view.name;
      for (const ColmapObservation& observation : image->observations) {
        const Eigen::Vector3d in_scene =
            Apply(scene.scene_from_world, model_.points.at(uint64_t(observation.point_id)).position);
        const Eigen::Vector3d p = Apply(InverseSimilarity(view.scene_from_camera), in_scene);
        EXPECT_NEAR(view.fx * p.x() / p.z() + view.cx, observation.x, 1e-6);
        EXPECT_NEAR(view.fy * p.y() / p.z() + view.cy, observation.y, 1e-6);
        ++n_compared;
      }
    }
    EXPECT_GT(n_compared, 6 * 30u);
  }
}

TEST_F(ScenePack, WithoutDistortionThePhotosArePackedUnchanged) {
  Make(4, 0);
  const Manifest manifest = Write();
  EXPECT_FALSE(manifest.facts.at("undistorted"));
  const Scene scene = LoadScene(pose_);
  const ImagePack pack(pose_);
  for (size_t i = 0; i < scene.views.size(); ++i) {
    const Image photo = ReadImageOriented(capture_.root / capture_.images[i].path);
    const uint8_t* pixels = pack.Pixels(scene.views[i]);
    EXPECT_EQ(std::vector<uint8_t>(pixels, pixels + scene.views[i].PixelBytes()), photo.pixels);
    EXPECT_EQ(scene.views[i].split, capture_.images[i].split);
  }
}

TEST_F(ScenePack, BytesDoNotDependOnTheNumberOfThreads) {
  Make(7, -0.05);
  PoseOptions options;
  options.max_image_size = 40;
  const std::string one = Write(options).ContentHash();
  options.n_threads = 4;
  EXPECT_EQ(Write(options).ContentHash(), one);
}

TEST_F(ScenePack, ViewsWithoutAPoseAreLeftOutAndListed) {
  Make(6, 0, {0, 1, 2, 4});
  const Manifest manifest = Write();
  EXPECT_EQ(manifest.facts.at("unregistered"), Json({"photo 3.png", "photo 5.png"}));
  EXPECT_EQ(manifest.facts.at("n_views_train"), 3);
  EXPECT_EQ(manifest.facts.at("n_views_test"), 1);
}

TEST_F(ScenePack, TransformsJsonHoldsTheSameCameras) {
  Make(5, -0.05);
  Write();
  fs::copy(capture_.root, pose_,
           fs::copy_options::recursive | fs::copy_options::skip_existing);  // so that file_path is found
  const auto source = ReadTransformsSource(pose_);
  ASSERT_TRUE(source && source->model);
  const ColmapModel pinhole = ReadColmapModel(pose_ / "sparse");
  ASSERT_EQ(source->model->images.size(), 5u);
  for (const auto& [id, image] : source->model->images) {
    for (const auto& [other_id, other] : pinhole.images) {
      if (other.name != image.name) continue;
      EXPECT_LT((image.Center() - other.Center()).norm(), 1e-9);
      EXPECT_LT(image.rotation.angularDistance(other.rotation), 1e-7);
      const std::vector<double>& params = source->model->cameras.at(image.camera_id).params;
      EXPECT_NEAR(params[0], pinhole.cameras.at(other.camera_id).params[0], 1e-6);
    }
  }
}

TEST_F(ScenePack, PointsComeInTheSceneFrame) {
  Make(4, 0);
  Write();
  const std::string ply = ReadFile(pose_ / "points.ply");
  EXPECT_THAT(ply, HasSubstr("element vertex 40\n"));
  const size_t body = ply.find("end_header\n") + 11;
  ASSERT_EQ(ply.size() - body, 40 * 15u);
  float xyz[3];
  std::memcpy(xyz, ply.data() + body, sizeof xyz);
  const Eigen::Vector3d expected = Apply(LoadScene(pose_).scene_from_world, model_.points.begin()->second.position);
  for (int i = 0; i < 3; ++i) EXPECT_NEAR(xyz[i], expected[i], 1e-5);
  EXPECT_EQ(uint8_t(ply[body + 14]), 200);
}

TEST_F(ScenePack, SparseDepthsArePointsOnRaysOfTrainingViewsAlone) {
  Make(7, 0);
  const Manifest manifest = Write();
  const Scene scene = LoadScene(pose_);
  const std::vector<SparseDepth> depths = LoadSparseDepths(scene, pose_);
  EXPECT_GT(depths.size(), 35u * scene.ViewsOf(Split::kTrain).size());  // of 40; a few are seen at too small an angle
  EXPECT_LE(depths.size(), 40u * scene.ViewsOf(Split::kTrain).size());
  EXPECT_EQ(manifest.facts.at("n_depths"), depths.size());
  const Eigen::Vector3d expected = Apply(scene.scene_from_world, model_.points.begin()->second.position);
  for (int i = 0; i < 3; ++i) EXPECT_NEAR(depths.front().position[i], expected[i], 1e-5);
}

// Two training views `angle` to either side of the normal of their baseline, and one held out, look at a point.
struct TwoViews {
  explicit TwoViews(double angle) {
    const double x[] = {-kDistance * std::sin(angle), kDistance * std::sin(angle), 3};
    ColmapPoint& point = model.points[1];
    point.position = {1, 1, 1};  // as COLMAP has it, with the held-out view's help: only a start
    for (uint32_t i = 0; i < 3; ++i) {
      View view;
      view.split = i < 2 ? Split::kTrain : Split::kTest;
      view.fx = view.fy = kFocal_px;
      view.cx = 50;
      view.cy = 40;
      view.scene_from_camera = {1, 0, 0, x[i], 0, 1, 0, 0, 0, 0, 1, -kDistance * std::cos(angle), 0, 0, 0, 1};
      scene.views.push_back(view);
      const double off_px = i < 2 ? 0 : 30;  // the held-out view is wrong about it
      model.images[i].observations = {{50 - kFocal_px * x[i] / (kDistance * std::cos(angle)) + off_px, 40 + off_px, 1}};
      point.track.emplace_back(i, 0u);
    }
  }
  std::vector<SparseDepth> Measure() const {
    return MeasureSparseDepths(model, {{0, 0}, {1, 1}, {2, 2}}, scene, Eigen::Matrix4d::Identity());
  }
  static constexpr double kDistance = 5, kFocal_px = 100;
  Scene scene;
  ColmapModel model;
};

TEST(SparseDepths, ArePointsAndUncertaintiesOfTheTrainingRaysAlone) {
  const double a = 0.3;
  TwoViews views(a);
  const std::vector<SparseDepth> depths = views.Measure();
  ASSERT_EQ(depths.size(), 2u);
  // e = ½ px at least; σ² = (e D/f)² (tan² a + cot² a)/2
  const double expected = 0.5 * TwoViews::kDistance / TwoViews::kFocal_px *
                          std::sqrt((std::pow(std::tan(a), 2) + std::pow(std::tan(a), -2)) / 2);
  for (const SparseDepth& depth : depths) {
    EXPECT_NEAR(depth.sigma, expected, 1e-6 * expected);
    for (const float coordinate : depth.position) EXPECT_NEAR(coordinate, 0, 1e-6);
  }
  views.model.points[1].track.erase(views.model.points[1].track.begin());
  EXPECT_TRUE(views.Measure().empty()) << "one training view tells no depth";
}

TEST(SparseDepths, ResidualsRaiseTheUncertainty) {
  TwoViews views(0.3);
  const float sigma = views.Measure().at(0).sigma;
  // Both rays miss the point by 1 px up and down, seen at 0.3 rad off the axis: 2 cos² squared px on one degree of
  // freedom instead of ½ px.
  views.model.images[0].observations[0].y += 1;
  views.model.images[1].observations[0].y -= 1;
  const double expected = std::sqrt(2.) * std::cos(0.3) / 0.5;
  EXPECT_NEAR(views.Measure().at(0).sigma / sigma, expected, 0.01 * expected);
}

TEST(SparseDepths, RaysThatHardlyCrossOrCrossBehindTellNothing) {
  EXPECT_TRUE(TwoViews(0.05).Measure().empty()) << "uncertain by 7 % of the distance";
  TwoViews views(0.3);
  std::swap(views.model.images[0].observations, views.model.images[1].observations);
  EXPECT_TRUE(views.Measure().empty()) << "the rays part";
}

TEST_F(ScenePack, DamagedDepthsAreNamed) {
  Make(4, 0);
  Write();
  const Scene scene = LoadScene(pose_);
  const std::string bytes = ReadFile(pose_ / kDepthFile);
  const auto expect_error = [&](const std::optional<std::string>& damaged, const std::string& text) {
    fs::remove(pose_ / kDepthFile);
    if (damaged) WriteFileAtomically(pose_ / kDepthFile, *damaged);
    try {
      LoadSparseDepths(scene, pose_);
      FAIL() << text;
    } catch (const Error& error) {
      EXPECT_EQ(error.code(), ExitCode::kCorrupt);
      EXPECT_THAT(error.what(), HasSubstr(text));
    }
  };
  expect_error({}, "is missing");
  expect_error(bytes.substr(0, bytes.size() - 3), "ends within a record");
  const auto with_view = [&](uint32_t view) {
    std::string damaged = bytes;
    std::memcpy(damaged.data(), &view, sizeof view);
    return damaged;
  };
  expect_error(with_view(1000), "view 1000 in record 0");
  expect_error(with_view(uint32_t(scene.ViewsOf(Split::kTest)[0])), "not a training view");
  std::string damaged = bytes;
  const float nan = NAN;
  std::memcpy(damaged.data() + 20 + 4, &nan, sizeof nan);
  expect_error(damaged, "cannot be in record 1");
}

TEST_F(ScenePack, DecisionsCanBeForced) {
  Make(4, -0.05);
  PoseOptions options;
  options.undistortion = false;
  options.contraction = false;
  const Manifest manifest = Write(options);
  EXPECT_FALSE(manifest.facts.at("undistorted"));
  EXPECT_FALSE(manifest.facts.at("unbounded"));
  for (const Decision& decision : manifest.decisions) EXPECT_EQ(decision.reason, "forced by an option");
}

TEST_F(ScenePack, APhotoThatChangedIsNamed) {
  Make(4, 0);
  WriteFileAtomically(capture_.root / "photo 2.png", "other");
  ExpectInputError("photo 2.png has changed since it was ingested");
  EXPECT_FALSE(fs::exists(pose_));
}

TEST_F(ScenePack, TwoTrainingViewsAreNeeded) {
  Make(6, 0, {0, 1, 3});
  ExpectInputError("only 1 of the training photos");
}

TEST_F(ScenePack, ACameraOfAnotherSizeIsAnError) {
  Make(4, 0);
  model_.cameras[3].width = 128;
  WriteColmapBinary(model_, ingest_ / "sparse");
  ExpectInputError("64×48");
}

}  // namespace
}  // namespace nrff
