// Poses from photos, with a COLMAP made of a shell script: every way it may behave, and one run of the real program.
#include "sfm/estimate.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sqlite3.h>

#include <algorithm>
#include <cstdlib>
#include <functional>
#include <numeric>

#include "pipeline/error.h"
#include "pipeline/extension.h"
#include "pipeline/process.h"
#include "sfm/base_mapping.h"
#include "sfm/colmap_database.h"
#include "sfm/image_pairs.h"
#include "sfm/ingest.h"
#include "sfm/merged_model.h"
#include "sfm/pieces.h"
#include "sfm/sfm_diagnosis.h"
#include "sfm/working_photos.h"
#include "tests/bundle_fixture.h"
#include "tests/pose_fixture.h"
#include "tests/temporary_directory.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;
using ::testing::AllOf;
using ::testing::HasSubstr;
using ::testing::Not;

// Answers as COLMAP 3.8, unless $FAKE/COMMAND is a script to run instead. Every call is written to $FAKE/calls. The
// database and the models it "computes" are those that lie in $FAKE.
constexpr char kFakeColmap[] = R"sh(#!/bin/sh
command=$1; shift
case "$1" in
  --help) [ -e "$FAKE/help" ] && cat "$FAKE/help"; exit 0 ;;
esac
[ "$command" = help ] && { echo "COLMAP 3.8 -- Structure-from-Motion"; exit 0; }
echo "$command $*" >> "$FAKE/calls"
[ -e "$FAKE/$command" ] && exec sh "$FAKE/$command"
while [ $# -gt 1 ]; do
  case $1 in --database_path) database=$2 ;; --output_path) output=$2 ;; esac
  shift 2
done
case $command in
  feature_extractor) cp "$FAKE/database.db" "$database"; echo "Processed file [1/8]" ;;
  mapper)
    models="$FAKE/$(basename "$output")"  # models, joined, lenses
    cp -r "$models"/. "$output"; echo "Registering image #1 (3)"
    ;;
esac
)sh";

constexpr char kHelp38[] =
    "--database_path arg\n--image_path arg\n--input_path arg\n--output_path arg\n--image_list_path arg\n"
    "--match_list_path arg\n--random_seed arg\n"
    "--ImageReader.camera_model arg\n--ImageReader.camera_params arg\n"
    "--SiftExtraction.use_gpu arg\n--SiftExtraction.peak_threshold arg\n--SiftMatching.use_gpu "
    "arg\n--Mapper.min_model_size arg\n";
constexpr char kHelp313[] =
    "--database_path arg\n--image_path arg\n--output_path arg\n--image_list_path arg\n--match_list_path arg\n"
    "--default_random_seed arg\n--FeatureExtraction.use_gpu arg\n--FeatureMatching.use_gpu "
    "arg\n--Mapper.min_model_size arg\n";

class Estimate : public ::testing::Test {
 protected:
  void SetUp() override {
    fs::create_directories(fake_ / "models");
    Script("colmap", kFakeColmap);
    fs::permissions(fake_ / "colmap", fs::perms::owner_all);
    WriteFileAtomically(fake_ / "help", kHelp38);
    setenv("FAKE", fake_.c_str(), 1);
    setenv("NRFF_COLMAP", (fake_ / "colmap").c_str(), 1);
    capture_ = MakeCapture(dir_.path() / "photos", 8, false);
    fs::create_directories(ingest_);
    SaveCapture(capture_, ingest_);
    MakeDatabase(100);
  }
  void TearDown() override {
    unsetenv("FAKE");
    unsetenv("NRFF_COLMAP");
  }

  void Script(const std::string& command, const std::string& text) { WriteFileAtomically(fake_ / command, text); }

  // COLMAP's tables with all photos, `n_keypoints` features each, all pairs with `n_matches` verified matches.
  void MakeDatabase(int n_matches, int n_keypoints = 1000) {
    MakeDatabase([&](int, int) { return n_matches; }, n_keypoints);
  }
  void MakeDatabase(const std::function<int(int, int)>& n_matches, int n_keypoints = 1000) {
    fs::remove(fake_ / "database.db");
    std::string sql =
        "CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT, camera_id INTEGER);"
        "CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB);"
        "CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB);"
        "CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY, model INTEGER, width INTEGER, height INTEGER, params "
        "BLOB,"
        " prior_focal_length INTEGER);"
        "INSERT INTO cameras VALUES (1, 2, 32, 24, zeroblob(32), 0);"
        "CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY, rows INTEGER);";
    for (size_t i = 0; i < capture_.images.size(); ++i) {
      const std::string id = std::to_string(i + 1);
      sql += "INSERT INTO images VALUES (" + id + ", '" + WorkingPhotoName(capture_.images[i]) + "', 1);";
      sql += "INSERT INTO keypoints VALUES (" + id + ", " + std::to_string(n_keypoints) + ", 6, NULL);";
      sql += "INSERT INTO descriptors VALUES (" + id + ", 2, 128, zeroblob(256));";
    }
    for (const auto& [a, b] : AllPairs(int(capture_.images.size()))) {
      sql += "INSERT INTO two_view_geometries VALUES (" + std::to_string(2147483647LL * (a + 1) + b + 1) + ", " +
             std::to_string(n_matches(a, b)) + ");";
    }
    sqlite3* database = nullptr;
    ASSERT_EQ(sqlite3_open((fake_ / "database.db").c_str(), &database), SQLITE_OK);
    ASSERT_EQ(sqlite3_exec(database, sql.c_str(), nullptr, nullptr, nullptr), SQLITE_OK);
    sqlite3_close(database);
  }

  // What the mapper finds: model `number` of these photos.
  void AddModel(int number, const std::vector<int>& photos, const std::string& folder = "models") {
    std::vector<std::string> names;
    names.reserve(photos.size());
    for (const int i : photos) names.push_back(WorkingPhotoName(capture_.images[size_t(i)]));
    AddModel(number, MakeModel(names, 32, 24, -0.05), folder);
  }
  void AddModel(int number, const ColmapModel& model, const std::string& folder) {
    const fs::path dir = fake_ / folder / std::to_string(number);
    fs::create_directories(dir);
    WriteColmapBinary(model, dir);
  }

  Manifest Run(const EstimateOptions& options = {}) {
    ArtifactWriter artifact("sfm", sfm_, {}, {}, ArtifactWriter::kKeepPartial);
    EstimatePoses(ingest_, options, artifact);
    artifact.Commit();
    return RequireArtifact(sfm_, "sfm");
  }

  template <typename Matcher>
  void ExpectError(ExitCode code, const Matcher& matcher, const EstimateOptions& options = {}) {
    try {
      Run(options);
      FAIL();
    } catch (const Error& error) {
      EXPECT_EQ(error.code(), code) << error.what();
      EXPECT_THAT(error.what(), matcher);
    }
    EXPECT_FALSE(fs::exists(sfm_));
  }

  static bool Decided(const Manifest& manifest, const std::string& feature) {
    for (const Decision& decision : manifest.decisions) {
      if (decision.feature == feature) return decision.needed;
    }
    ADD_FAILURE() << feature << " was not decided";
    return false;
  }
  std::string Calls() { return fs::exists(fake_ / "calls") ? ReadFile(fake_ / "calls") : std::string(); }

  TemporaryDirectory dir_;
  fs::path fake_ = dir_.path() / "fake", ingest_ = dir_.path() / "ingest", sfm_ = dir_.path() / "sfm";
  Capture capture_;
};

TEST_F(Estimate, TheModelComesNamedByIdAndAtThePhotosSize) {
  AddModel(0, {0, 1, 2, 3, 4, 5, 6, 7});
  EstimateOptions options;
  options.refine = false;
  const Manifest manifest = Run(options);
  const ColmapModel model = ReadColmapModel(sfm_ / "sparse");
  ASSERT_EQ(model.images.size(), 8u);
  EXPECT_EQ(model.images.begin()->second.name, "000000");
  const ColmapCamera& camera = model.cameras.begin()->second;
  EXPECT_EQ(camera.width, 64);
  EXPECT_EQ(camera.height, 48);
  EXPECT_DOUBLE_EQ(camera.params[0], 1.2 * 64);
  EXPECT_DOUBLE_EQ(camera.params[3], -0.05);
  // Observations move with it: the same as those of a model made at this size.
  const ColmapModel expected = MakeModel(std::vector<std::string>(8), 64, 48, -0.05);
  EXPECT_NEAR(model.images.at(12).observations[7].x, expected.images.at(12).observations[7].x, 1e-9);
  EXPECT_EQ(manifest.facts.at("n_registered"), 8);
  EXPECT_EQ(manifest.facts.at("n_registered_test"), 3);
  EXPECT_EQ(manifest.facts.at("reprojection_error_px"), 1.0);  // 0.5 px of a photo half the size
  EXPECT_EQ(manifest.facts.at("colmap_version"), "3.8");
  EXPECT_FALSE(fs::exists(sfm_ / "work"));
  EXPECT_TRUE(fs::exists(sfm_ / "colmap.log"));
}

TEST_F(Estimate, TheModelIsRefinedUnlessThatIsLeftOut) {
  std::vector<std::string> names;
  for (const CaptureImage& photo : capture_.images) names.push_back(WorkingPhotoName(photo));
  ColmapModel model = MakeModel(names, 32, 24, -0.05);
  for (auto& [id, image] : model.images) image.translation += Eigen::Vector3d(0.004 * double(id % 3), 0, 0);
  AddModel(0, model, "models");
  EstimateOptions options;
  options.refine = false;
  EXPECT_FALSE(Decided(Run(options), "refinement"));
  const double before = ReadJson(sfm_ / "refinement.json").at("reprojection_error_px").at("before").at("mean");
  const Manifest refined = Run();
  EXPECT_TRUE(Decided(refined, "refinement"));
  EXPECT_EQ(ReadColmapModel(sfm_ / "sparse").cameras.begin()->second.params[1], 32);  // the principal point, as given
  EXPECT_GT(before, 0.01);
  EXPECT_LT(refined.facts.at("reprojection_error_px").get<double>(), 1e-3 * before);
}

TEST_F(Estimate, PhotosOfAZoomLensGetFocalLengthsOfTheirOwn) {
  ColmapModel model = Ring({1, CameraModel::kSimpleRadial, 64, 48, {55, 32, 24, -0.05}}, 8, 1500);
  const ColmapCamera shared = model.cameras.at(1);
  for (auto& [id, image] : model.images) {
    image.camera_id = 10 + id;
    model.cameras[10 + id] = shared;
    model.cameras[10 + id].params[0] *= 0.95 + 0.1 * double(3 * id % 8) / 7;
  }
  Observe(model);
  AddNoise(model, 0.03, 5);
  for (auto& [id, image] : model.images) {
    image.camera_id = 1;
    image.name = WorkingPhotoName(capture_.images[id - 1]);
  }
  model.cameras = {{1, shared}};
  AddModel(0, model, "models");
  EXPECT_TRUE(Decided(Run(), "own_focal_lengths"));
  const ColmapModel own = ReadColmapModel(sfm_ / "sparse");
  ASSERT_EQ(own.cameras.size(), 8u);
  for (const auto& [id, image] : own.images)
    EXPECT_NEAR(own.cameras.at(image.camera_id).params[0], 55 * (0.95 + 0.1 * double(3 * id % 8) / 7), 0.3);
  EXPECT_EQ(ReadColmapModel(sfm_ / "mapping/model").cameras.size(), 1u);  // what another estimate goes on from
  EstimateOptions options;
  options.own_focal_lengths = false;
  EXPECT_FALSE(Decided(Run(options), "own_focal_lengths"));
  EXPECT_EQ(ReadColmapModel(sfm_ / "sparse").cameras.size(), 1u);
}

TEST_F(Estimate, TurnedPhotosShareTheirCamerasLens) {
  for (const size_t i : {1u, 4u, 6u}) {
    ImageInfo& info = capture_.images[i].info;
    info.orientation = i == 4 ? 8 : 6;
    std::swap(info.width, info.height);
  }
  SaveCapture(capture_, ingest_);
  ColmapModel model = Ring({1, CameraModel::kSimpleRadial, 32, 24, {28, 16, 11, -0.05}}, 8, 200);
  for (auto& [id, image] : model.images) image.name = WorkingPhotoName(capture_.images[id - 1]);
  AddModel(0, model, "models");
  Run();
  const ColmapModel found = ReadColmapModel(sfm_ / "sparse");
  ASSERT_EQ(found.cameras.size(), 3u);
  for (const auto& [id, image] : found.images) {
    const ImageInfo& info = capture_.images[size_t(std::stoi(image.name))].info;
    const ColmapCamera& camera = found.cameras.at(image.camera_id);
    EXPECT_EQ(std::pair(camera.width, camera.height), std::pair(info.width, info.height));
    for (const ColmapObservation& seen : image.observations) {
      const Eigen::Vector3d in_camera =
          image.rotation * found.points.at(uint64_t(seen.point_id)).position + image.translation;
      const auto px = Lens(camera).ImageFromCamera(in_camera.hnormalized());
      EXPECT_LT((*px - Eigen::Vector2d(seen.x, seen.y)).norm(), 1e-6) << image.name;
    }
  }
}

TEST_F(Estimate, TheLargestOfSeveralModelsIsTaken) {
  AddModel(0, {0, 1, 2});
  AddModel(1, {0, 1, 3, 4, 5, 6, 7});
  AddModel(2, {2, 3, 4});
  const Manifest manifest = Run();
  EXPECT_EQ(manifest.facts.at("n_registered"), 7);
  EXPECT_EQ(manifest.facts.at("n_models"), 3);
  EXPECT_EQ(manifest.facts.at("unregistered"), Json({"photo 2.png"}));
}

TEST_F(Estimate, TooFewPhotosAreTriedOnceMoreWithMore) {
  AddModel(0, {0, 1, 2, 3, 4});
  const Manifest manifest = Run();
  ASSERT_EQ(manifest.facts.at("attempts").size(), 2u);
  EXPECT_EQ(manifest.facts.at("attempts")[0].at("n_registered"), 5);
  EXPECT_GT(manifest.facts.at("attempts")[1].at("max_features"), manifest.facts.at("attempts")[0].at("max_features"));
}

// A ring of eight photos with a lens that has a moustache, mapped as if it had none.
TEST_F(Estimate, RicherLensesAreTakenWherePhotosNeedThem) {
  const auto mapped = [&](double focal_px, double k, double k2) {
    ColmapModel model = Ring({1, CameraModel::kRadial, 64, 48, {focal_px, 32, 24, k, k2}}, 8, 1500);
    AddNoise(model, 0.03, 5);
    for (auto& [id, image] : model.images) image.name = WorkingPhotoName(capture_.images[id - 1]);
    fs::remove_all(fake_ / "models");
    fs::remove_all(fake_ / "lenses");
    AddModel(0, model, "lenses");
    model.cameras.at(1) = {1, CameraModel::kSimpleRadial, 64, 48, {focal_px, 32, 24, k / 2}};
    AddModel(0, model, "models");
    fs::remove(fake_ / "calls");
  };
  mapped(55, -0.4, 0.6);
  const Manifest narrow = Run();
  EXPECT_TRUE(Decided(narrow, "richer_lens"));
  EXPECT_EQ(narrow.facts.at("camera_models"), Json({"RADIAL"}));
  EXPECT_EQ(narrow.facts.at("attempts").size(), 2u);
  EXPECT_EQ(narrow.facts.at("n_registered"), 8);
  EXPECT_THAT(Calls(), Not(HasSubstr("lenses.db")));
  const ColmapModel found = ReadColmapModel(sfm_ / "sparse");
  EXPECT_NEAR(found.cameras.at(1).params[3], -0.4, 0.03);
  EXPECT_NEAR(found.cameras.at(1).params[4], 0.6, 0.1);
  // Of wide ones, matches are verified and photos mapped again.
  mapped(34, -0.2, 0.1);
  const Manifest wide = Run();
  EXPECT_EQ(wide.facts.at("camera_models"), Json({"RADIAL"}));
  EXPECT_GT(wide.facts.at("field_of_view_deg"), 95);
  EXPECT_THAT(Calls(), AllOf(HasSubstr("matches_importer"), HasSubstr("lenses.db")));
  // Not where another model is asked for.
  fs::remove(fake_ / "calls");
  EstimateOptions options;
  options.camera_model = CameraModel::kSimpleRadial;
  const Manifest forced = Run(options);
  EXPECT_EQ(forced.facts.at("camera_models"), Json({"SIMPLE_RADIAL"}));
  EXPECT_THAT(Calls(), Not(HasSubstr("lenses.db")));
}

// Photos with a focal length of 20 mm are mapped as a fisheye's, too.
TEST_F(Estimate, FisheyesAreThoseThatExplainMore) {
  for (CaptureImage& photo : capture_.images) photo.info.focal_px = 37;
  SaveCapture(capture_, ingest_);
  AddModel(0, {0, 1, 2, 3, 4, 5, 6, 7});
  const auto as_fisheye = [&](int n_points) {
    ColmapModel model = Ring({1, CameraModel::kOpenCVFisheye, 64, 48, {30, 30, 32, 24, 0, 0, 0, 0}}, 8, n_points);
    for (auto& [id, image] : model.images) image.name = WorkingPhotoName(capture_.images[id - 1]);
    fs::remove_all(fake_ / "fisheye");
    AddModel(0, model, "fisheye");
  };
  as_fisheye(30);  // fewer than the 40 that all photos of the simple model see
  Manifest manifest = Run();
  EXPECT_FALSE(Decided(manifest, "fisheye"));
  EXPECT_EQ(manifest.facts.at("camera_models"), Json({"SIMPLE_RADIAL"}));
  EXPECT_THAT(Calls(), HasSubstr("fisheye.db"));
  as_fisheye(300);
  manifest = Run();
  EXPECT_TRUE(Decided(manifest, "fisheye"));
  EXPECT_EQ(manifest.facts.at("camera_models"), Json({"OPENCV_FISHEYE"}));
  // With 35 mm they are no fisheye's, however much one would explain.
  for (CaptureImage& photo : capture_.images) photo.info.focal_px = 65;
  SaveCapture(capture_, ingest_);
  fs::remove(fake_ / "calls");
  EXPECT_EQ(Run().facts.at("camera_models"), Json({"SIMPLE_RADIAL"}));
  EXPECT_THAT(Calls(), Not(HasSubstr("fisheye.db")));
}

TEST_F(Estimate, LensesAreStartedFromAsAsked) {
  AddModel(0, {0, 1, 2, 3, 4, 5, 6, 7});
  for (CaptureImage& photo : capture_.images) photo.info.focal_px = 50;
  SaveCapture(capture_, ingest_);
  EstimateOptions options;
  options.camera_model = CameraModel::kOpenCVFisheye;
  Run(options);
  EXPECT_THAT(Calls(), AllOf(HasSubstr("--ImageReader.camera_model OPENCV_FISHEYE"),
                             HasSubstr("--ImageReader.camera_params 50.0,50.0,32.0,24.0,0.0,0.0,0.0,0.0")));
}

TEST_F(Estimate, FoundLensesAreWrittenIntoTheDatabaseAndMatchesForgotten) {
  const ColmapCamera lens{1, CameraModel::kRadial, 64, 48, {45, 32, 24, -0.25, 0.3}};
  SetLenses(fake_ / "database.db", {{1, lens}});
  const ColmapDatabase database = ReadColmapDatabase(fake_ / "database.db");
  EXPECT_TRUE(database.verified_matches.empty());
  EXPECT_EQ(database.images.size(), 8u);
  sqlite3* connection = nullptr;
  ASSERT_EQ(sqlite3_open((fake_ / "database.db").c_str(), &connection), SQLITE_OK);
  sqlite3_stmt* row = nullptr;
  sqlite3_prepare_v2(connection, "SELECT model, width, params, prior_focal_length FROM cameras", -1, &row, nullptr);
  ASSERT_EQ(sqlite3_step(row), SQLITE_ROW);
  EXPECT_EQ(sqlite3_column_int(row, 0), 3);
  EXPECT_EQ(sqlite3_column_int(row, 1), 64);
  ASSERT_EQ(sqlite3_column_bytes(row, 2), int(5 * sizeof(double)));
  EXPECT_EQ(static_cast<const double*>(sqlite3_column_blob(row, 2))[4], 0.3);
  EXPECT_EQ(sqlite3_column_int(row, 3), 1);
  sqlite3_finalize(row);
  sqlite3_close(connection);
}

TEST_F(Estimate, FainterFeaturesAreTakenWherePhotosHaveFew) {
  AddModel(0, {0, 1, 2, 3, 4, 5, 6, 7});
  Manifest manifest = Run();
  EXPECT_EQ(manifest.facts.at("attempts")[0].at("peak_threshold"), 0);
  EXPECT_THAT(Calls(), Not(HasSubstr("peak_threshold")));
  MakeDatabase(100, 300);
  manifest = Run();
  ASSERT_EQ(manifest.facts.at("attempts").size(), 1u);
  EXPECT_EQ(manifest.facts.at("attempts")[0].at("peak_threshold"), 0.004);
  EXPECT_THAT(Calls(), HasSubstr("--SiftExtraction.peak_threshold 0.004"));
}

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
  EXPECT_EQ(manifest.decisions.back().feature, "poses_anew");
  EXPECT_FALSE(manifest.decisions.back().needed);
  // The one mapping there was: of the model kept, and pairs with an added photo alone.
  EXPECT_THAT(Calls(), HasSubstr("--input_path " + (base_ / kMappingDir / "model").string()));
  EXPECT_EQ(manifest.facts.at("attempts").at(0).at("n_pairs"), 8 * 7 / 2 - 6 * 5 / 2);
  EXPECT_EQ(manifest.facts.at("attempts").size(), 1u);
}

TEST_F(EstimateExtended, PhotosThatDoNotGrowOnAreMappedFromScratch) {
  GrowTo(Grown(Eigen::Matrix4d::Identity(), 7));
  AddModel(0, {0, 1, 2, 3, 4, 5, 6, 7});
  const Manifest manifest = Run(options_);
  EXPECT_EQ(manifest.facts.at("n_registered"), 8);
  EXPECT_EQ(manifest.facts.at("extension").at("mapped_anew"), true);
  EXPECT_TRUE(manifest.decisions.back().needed);
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

TEST_F(Estimate, LessThanHalfThePhotosIsAnErrorWithADiagnosis) {
  AddModel(0, {0, 1, 2});
  MakeDatabase(20);
  ExpectError(ExitCode::kInput, AllOf(HasSubstr("only 3 of 8 photos could be placed"), HasSubstr("photo 5.png (20)"),
                                      HasSubstr("overlap too little")));
}

TEST_F(Estimate, FramesOfAVideoThatOverlapTooLittleCanBeMore) {
  ColmapDatabase database;
  for (size_t i = 0; i < capture_.images.size(); ++i) {
    capture_.images[i].extracted = true;
    database.images[uint32_t(i + 1)] = {WorkingPhotoName(capture_.images[i]), 1, 900};
  }
  EXPECT_THAT(DiagnoseRegistration(capture_, database, nullptr),
              HasSubstr("overlap too little: take more frames of the video with --frames"));
}

TEST_F(Estimate, PhotosFromOnePlaceAreDiagnosed) {
  Script("mapper", "echo 'ERROR: failed to create sparse model' >&2; exit 1");
  MakeDatabase(900);
  ExpectError(ExitCode::kInput, AllOf(HasSubstr("only 0 of 8"), HasSubstr("move the camera")));
}

TEST_F(Estimate, SaysHowToInstallAMissingColmap) {
  setenv("NRFF_COLMAP", "/no/such/colmap", 1);
  ExpectError(ExitCode::kExternalTool, AllOf(HasSubstr("/no/such/colmap"), HasSubstr("apt-get install colmap")));
}

TEST_F(Estimate, AProgramThatIsNotColmapIsAnError) {
  setenv("NRFF_COLMAP", "/bin/echo", 1);
  ExpectError(ExitCode::kExternalTool, HasSubstr("does not say that it is COLMAP"));
}

TEST_F(Estimate, AFailingColmapIsQuoted) {
  Script("feature_extractor", "echo working; echo 'Check failed: no memory' >&2; exit 134");
  ExpectError(ExitCode::kExternalTool, AllOf(HasSubstr("feature_extractor exited with status 134"),
                                             HasSubstr("Check failed: no memory"), HasSubstr("colmap.log")));
}

TEST_F(Estimate, ACrashingMapperIsNotADiagnosis) {
  Script("mapper", "kill -SEGV $$");
  ExpectError(ExitCode::kExternalTool, AllOf(HasSubstr("mapper"), HasSubstr("signal 11")));
}

TEST_F(Estimate, AHangingColmapIsStopped) {
  Script("feature_extractor", "sleep 60");
  EstimateOptions options;
  options.stall_limit_seconds = 0.5;
  ExpectError(ExitCode::kExternalTool, HasSubstr("neither printed nor used the processor"), options);
}

TEST_F(Estimate, SpeaksTheNamesOfOldAndNewColmaps) {
  AddModel(0, {0, 1, 2, 3, 4, 5, 6, 7});
  Run();
  EXPECT_THAT(Calls(),
              AllOf(HasSubstr("--SiftExtraction.use_gpu 0"), HasSubstr("--random_seed 0"), Not(HasSubstr("Feature"))));
  fs::remove(fake_ / "calls");
  WriteFileAtomically(fake_ / "help", kHelp313);
  Run();
  EXPECT_THAT(Calls(), AllOf(HasSubstr("--FeatureExtraction.use_gpu 0"), HasSubstr("--default_random_seed 0"),
                             Not(HasSubstr("Sift"))));
}

TEST_F(Estimate, AnInterruptedRunGoesOn) {
  AddModel(0, {0, 1, 2, 3, 4, 5, 6, 7});
  Script("mapper", "exit 1");
  ExpectError(ExitCode::kExternalTool, HasSubstr("mapper"));
  fs::remove(fake_ / "mapper");
  fs::remove(fake_ / "calls");
  Run();
  EXPECT_THAT(Calls(),
              AllOf(HasSubstr("mapper"), Not(HasSubstr("feature_extractor")), Not(HasSubstr("matches_importer"))));
}

TEST_F(Estimate, MatchingCanBeForcedOnTheCommandLine) {
  AddModel(0, {0, 1, 2, 3, 4, 5, 6, 7});
  ArtifactWriter ingest("ingest", ingest_, {}, {});
  SaveCapture(capture_, ingest.dir());
  ingest.AddOutput(kCaptureFile);
  ingest.Commit();
  for (const std::string matching : {"selective", "exhaustive"}) {
    ProcessOptions process;
    process.command = {std::string(NRFF_BIN_DIR) + "/nrff-pose",
                       "estimate",
                       "--ingest",
                       ingest_.native(),
                       "--out",
                       sfm_.native(),
                       "--matching",
                       matching};
    const ProcessResult result = RunProcess(process);
    ASSERT_TRUE(result.Succeeded()) << ::testing::PrintToString(result.last_lines);
    const Manifest manifest = RequireArtifact(sfm_, "sfm");
    EXPECT_EQ(manifest.facts.at("matching"), matching);
    EXPECT_EQ(manifest.params, (Params{{"matching", matching}}));
    EXPECT_EQ(manifest.decisions.at(0).reason, "forced by an option");
  }
}

TEST(EstimateWithColmap, ARealCaptureRegisters) {
  const char* given = std::getenv("NRFF_DATA");
  const fs::path data = given ? fs::path(given) : fs::path(NRFF_SOURCE_DIR) / ".." / "shared" / "data";
  const fs::path photos = data / "photos" / "kermit";
  if (!fs::exists(photos)) GTEST_SKIP() << "no photos at " << photos;
  if (std::system("command -v colmap >/dev/null") != 0) GTEST_SKIP() << "COLMAP is not installed";
  TemporaryDirectory dir;
  {
    ArtifactWriter artifact("ingest", dir.path() / "ingest", {}, {});
    Ingest(photos, {}, artifact);
    artifact.Commit();
  }
  ArtifactWriter artifact("sfm", dir.path() / "sfm", {}, {}, ArtifactWriter::kKeepPartial);
  EstimateOptions options;
  options.n_threads = 2;
  EstimatePoses(dir.path() / "ingest", options, artifact);
  EXPECT_GE(artifact.facts().at("n_registered"), 9);
  EXPECT_LT(artifact.facts().at("reprojection_error_px"), 1.0);
}

}  // namespace
}  // namespace nrff
