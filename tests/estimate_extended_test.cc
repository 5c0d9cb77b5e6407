// Poses of photos that were added to others.
#include "pipeline/extension.h"
#include "sfm/base_mapping.h"
#include "sfm/merged_model.h"
#include "sfm/sfm_settings.h"
#include "tests/bundle_fixture.h"
#include "tests/estimate_fixture.h"

namespace nrff {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;

// Six photos, and then two more; the fake mapper gives fake_/grown for what it is to grow.
class EstimateExtended : public Estimate {
 protected:
  void SetUp() override {
    Estimate::SetUp();
    const Capture all = capture_;
    capture_.images.resize(6);
    SaveCapture(capture_, ingest_);
    MakeDatabase(100);
    AddModel(0, {0, 1, 2, 3, 4, 5});
    earlier_ = Run();
    fs::rename(sfm_, base_);
    fs::remove(fake_ / "calls");
    capture_ = all;
    SaveCapture(capture_, ingest_);
    MakeDatabase(100);
    options_.base = base_;
  }

  // The earlier cameras and points as they were, moved by a similarity, and the two added ones.
  ColmapModel Grown(const Eigen::Matrix4d& moved, int n_photos = 8) const {
    std::vector<std::string> names;
    for (int i = 0; i < n_photos; ++i) names.push_back(WorkingPhotoName(capture_.images[size_t(i)]));
    ColmapModel grown = MakeModel(names, 32, 24, -0.05);
    const ColmapModel before = ReadColmapModel(base_ / kMappingDir / "model");
    for (const auto& [id, image] : before.images) grown.images.at(id) = image;
    return Transformed(grown, moved);
  }
  void GrowTo(const ColmapModel& grown) {
    fs::remove_all(fake_ / "grown");
    fs::create_directories(fake_ / "grown");
    WriteColmapBinary(grown, fake_ / "grown");
  }
  static Eigen::Matrix4d Moved() {
    Eigen::Matrix4d moved = Eigen::Matrix4d::Identity();
    moved.topLeftCorner<3, 3>() = 3 * Eigen::AngleAxisd(0.7, Eigen::Vector3d(1, 2, 3).normalized()).toRotationMatrix();
    moved.topRightCorner<3, 1>() << 5, -2, 1;
    return moved;
  }

  const fs::path base_ = dir_.path() / "base";
  Manifest earlier_;
  EstimateOptions options_;
};

TEST_F(EstimateExtended, TheModelGrowsAndStaysInItsWorld) {
  GrowTo(Grown(Moved()));
  const Manifest manifest = Run(options_);
  const Json extension = ReadJson(sfm_ / kExtensionFile);
  EXPECT_EQ(extension.at("frame_kept"), true);
  EXPECT_EQ(extension.at("n_added_placed"), 2);
  EXPECT_EQ(extension.at("mapped_anew"), false);
  EXPECT_LT(extension.at("largest_shift_px"), 1e-4);
  const ColmapModel before = ReadColmapModel(base_ / "sparse"), after = ReadColmapModel(sfm_ / "sparse");
  ASSERT_EQ(after.images.size(), 8u);
  for (const auto& [id, image] : before.images) {
    EXPECT_LT((after.images.at(id).Center() - image.Center()).norm(), 1e-5);
    EXPECT_LT(after.images.at(id).rotation.angularDistance(image.rotation), 1e-5);
  }
  for (const auto& [id, point] : before.points) EXPECT_LT((after.points.at(id).position - point.position).norm(), 1e-5);
  EXPECT_EQ(manifest.facts.at("n_registered"), 8);
  EXPECT_FALSE(Decided(manifest, "poses_anew"));
  EXPECT_FALSE(Decided(manifest, "own_focal_lengths"));
  // The one mapping there was: of the model kept, and pairs with an added photo alone.
  EXPECT_THAT(Calls(), HasSubstr("--input_path " + (base_ / kMappingDir / "model").string()));
  EXPECT_EQ(manifest.facts.at("attempts").at(0).at("n_pairs"), 8 * 7 / 2 - 6 * 5 / 2);
  EXPECT_EQ(manifest.facts.at("attempts").size(), 1u);
}

// Photos of a zoom lens: what COLMAP goes on from has shared focal lengths, and other poses than were exported.
TEST_F(EstimateExtended, OwnFocalLengthsAreHandedOnAndTheWorldIsTheExportedOne) {
  const ColmapCamera camera{1, CameraModel::kSimpleRadial, 32, 24, {28, 16, 12, -0.05}};
  ColmapModel all = ZoomedRing(camera, 8, 1500, 0.02, 0.3);
  for (auto& [id, image] : all.images) image.name = WorkingPhotoName(capture_.images[id - 1]);
  ColmapModel six = all;
  for (const uint32_t added : {7u, 8u}) {
    for (const ColmapObservation& seen : six.images.at(added).observations)
      std::erase_if(six.points.at(uint64_t(seen.point_id)).track, [&](const auto& o) { return o.first == added; });
    six.images.erase(added);
  }
  const Capture eight = capture_;
  capture_.images.resize(6);
  SaveCapture(capture_, ingest_);
  MakeDatabase(100);
  fs::remove_all(fake_ / "models");
  AddModel(0, six, "models");
  fs::remove_all(base_);
  EXPECT_TRUE(Decided(Run(), "own_focal_lengths"));
  fs::rename(sfm_, base_);
  capture_ = eight;
  SaveCapture(capture_, ingest_);
  MakeDatabase(100);
  const ColmapModel shared = ReadColmapModel(base_ / kMappingDir / "model");
  EXPECT_EQ(shared.cameras.size(), 1u);
  for (const auto& [id, image] : shared.images) all.images.at(id) = image;
  GrowTo(Transformed(all, Moved()));
  const Manifest manifest = Run(options_);
  EXPECT_TRUE(Decided(manifest, "own_focal_lengths"));
  EXPECT_EQ(manifest.facts.at("extension").at("frame_kept"), true);
  EXPECT_LT(manifest.facts.at("extension").at("largest_shift_px"), 0.1);
  const ColmapModel before = ReadColmapModel(base_ / "sparse"), after = ReadColmapModel(sfm_ / "sparse");
  ASSERT_EQ(after.cameras.size(), 8u);
  double shared_off = 0;
  for (const auto& [id, image] : before.images) {
    EXPECT_LT((after.images.at(id).Center() - image.Center()).norm(), 0.05);
    EXPECT_NEAR(after.cameras.at(id).params[0], before.cameras.at(id).params[0], 0.6);
    shared_off = std::max(shared_off, (shared.images.at(id).Center() - image.Center()).norm());
  }
  EXPECT_GT(shared_off, 0.1) << "or the test could not fail";
  // Photos mapped again do not take its place where they lie elsewhere: here each has the next one's, with more points
  // than the grown model then has.
  ColmapModel elsewhere = ZoomedRing(camera, 8, 1500, 0.02, 0.3);
  const ColmapModel ring = elsewhere;
  const auto before_next = [](uint32_t id) { return id == 1 ? 8 : id - 1; };
  for (const auto& [id, image] : ring.images) {
    ColmapImage& moved = elsewhere.images.at(before_next(id)) = image;
    moved.id = before_next(id);
    moved.name = WorkingPhotoName(capture_.images[moved.id - 1]);
    moved.camera_id = 50 + moved.id;
    elsewhere.cameras[moved.camera_id] = camera;
    elsewhere.cameras[moved.camera_id].params[0] *= ZoomOf(id, 8, 0.3);
  }
  elsewhere.cameras.erase(1);
  for (auto& [id, point] : elsewhere.points) {
    for (auto& [image, index] : point.track) image = before_next(image);
  }
  AddModel(0, elsewhere, "own");
  ColmapModel fewer = all;
  for (int i = 0; i < 400; ++i) {
    const auto point = std::prev(fewer.points.end());
    for (const auto& [image, index] : point->second.track) fewer.images.at(image).observations[index].point_id = -1;
    fewer.points.erase(point);
  }
  GrowTo(Transformed(fewer, Moved()));
  const Manifest again = Run(options_);
  EXPECT_TRUE(Decided(again, "own_focal_lengths"));
  EXPECT_EQ(again.facts.at("extension").at("frame_kept"), true);
  EXPECT_EQ(again.facts.at("n_points"), 1100);
  options_.own_focal_lengths = false;
  EXPECT_EQ(Run(options_).facts.at("extension").at("frame_kept"), false);
}

TEST_F(EstimateExtended, PhotosThatDoNotGrowOnAreMappedFromScratch) {
  GrowTo(Grown(Eigen::Matrix4d::Identity(), 7));
  AddModel(0, {0, 1, 2, 3, 4, 5, 6, 7});
  const Manifest manifest = Run(options_);
  EXPECT_EQ(manifest.facts.at("n_registered"), 8);
  EXPECT_EQ(manifest.facts.at("extension").at("mapped_anew"), true);
  EXPECT_TRUE(Decided(manifest, "poses_anew"));
}

TEST_F(EstimateExtended, AGrownModelThatHasMoreThanOneFromScratchStays) {
  GrowTo(Grown(Eigen::Matrix4d::Identity(), 7));
  AddModel(0, {0, 1, 2, 3, 4, 5});
  const Manifest manifest = Run(options_);
  EXPECT_EQ(manifest.facts.at("n_registered"), 7);
  EXPECT_EQ(manifest.facts.at("extension").at("mapped_anew"), false);
}

TEST_F(EstimateExtended, AModelThatBentIsNotInTheEarlierWorld) {
  ColmapModel bent = Grown(Eigen::Matrix4d::Identity());
  for (auto& [id, image] : bent.images) {
    const double angle = 0.1 * double(id % 3);  // 32 px wide: 2 px and more
    const Eigen::Quaterniond turned(Eigen::AngleAxisd(angle, Eigen::Vector3d::UnitY()));
    image.rotation = turned * image.rotation;
    image.translation = turned * image.translation;
  }
  GrowTo(bent);
  fs::remove_all(fake_ / "models");
  fs::create_directories(fake_ / "models/0");
  WriteColmapBinary(bent, fake_ / "models/0");
  options_.refine = false;  // which mends it
  const Manifest manifest = Run(options_);
  EXPECT_EQ(manifest.facts.at("extension").at("frame_kept"), false);
  EXPECT_EQ(manifest.facts.at("extension").at("mapped_anew"), true);
}

TEST_F(EstimateExtended, OtherSettingsOfFeaturesAreNoExtension) {
  options_.max_features = 999;
  AddModel(0, {0, 1, 2, 3, 4, 5, 6, 7});
  const Manifest manifest = Run(options_);
  EXPECT_FALSE(manifest.facts.contains("extension"));
  EXPECT_FALSE(fs::exists(sfm_ / kExtensionFile));
  EXPECT_THAT(Calls(), Not(HasSubstr("--input_path")));
}

TEST_F(EstimateExtended, AnotherLensIsNoExtension) {
  options_.camera_model = CameraModel::kOpenCV;
  AddModel(0, {0, 1, 2, 3, 4, 5, 6, 7});
  EXPECT_FALSE(Run(options_).facts.contains("extension"));
}

TEST(SfmSettings, ComeBackWithTheirLenses) {
  SfmSettings settings;
  settings.name = "fast, as fisheyes";
  settings.camera_model = CameraModel::kRadial;
  settings.lenses[3] = {0, CameraModel::kOpenCVFisheye, 640, 480, {300, 301, 320, 240, 0.1, -0.02, 0, 0}};
  const Json json = ToJson(settings);
  const SfmSettings read = SfmSettingsFromJson(json, "settings.json");
  EXPECT_EQ(ToJson(read), json);
  EXPECT_EQ(read.lenses.at(3).params, settings.lenses.at(3).params);
  EXPECT_EQ(read.camera_model, CameraModel::kRadial);
  for (const auto& [key, value] : {std::pair("camera_model", Json("PANORAMIC")), {"params", Json{1, 2}}}) {
    Json broken = json;
    broken["lenses"][0][key] = value;
    EXPECT_THROW(SfmSettingsFromJson(broken, "settings.json"), Error) << key;
  }
}

}  // namespace
}  // namespace nrff
