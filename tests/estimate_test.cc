// Poses from photos, with a COLMAP made of a shell script: every way it may behave, and one run of the real program.
#include "sfm/estimate.h"

#include <cstdlib>

#include "pipeline/process.h"
#include "sfm/bundle_refinement.h"
#include "sfm/colmap_database.h"
#include "sfm/final_model.h"
#include "sfm/sfm_diagnosis.h"
#include "tests/bundle_fixture.h"
#include "tests/estimate_fixture.h"

namespace nrff {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;
using ::testing::Not;

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
  // Working copies half as large as the photos.
  ColmapModel model = ZoomedRing({1, CameraModel::kSimpleRadial, 32, 24, {27.5, 16, 12, -0.05}}, 8, 1500, 0.015, 0.1);
  for (auto& [id, image] : model.images) image.name = WorkingPhotoName(capture_.images[id - 1]);
  AddModel(0, model, "models");
  EXPECT_TRUE(Decided(Run(), "own_focal_lengths"));
  EXPECT_EQ(ReadJson(sfm_ / kRefinementName).at("iterations"), 0) << "certified as it was solved";
  const ColmapModel own = ReadColmapModel(sfm_ / "sparse");
  ASSERT_EQ(own.cameras.size(), 8u);
  for (const auto& [id, image] : own.images)
    EXPECT_NEAR(own.cameras.at(image.camera_id).params[0], 55 * ZoomOf(id, 8, 0.1), 0.3);
  EXPECT_EQ(ReadColmapModel(sfm_ / "mapping/model").cameras.size(), 1u);  // what another estimate goes on from
  EstimateOptions options;
  options.own_focal_lengths = false;
  EXPECT_FALSE(Decided(Run(options), "own_focal_lengths"));
  EXPECT_EQ(ReadColmapModel(sfm_ / "sparse").cameras.size(), 1u);
  options = {};
  options.refine = false;  // which they are part of
  EXPECT_FALSE(Decided(Run(options), "own_focal_lengths"));
}

// With a camera for each photo the mapper finds more: what it finds is taken, from the matches that there were.
TEST_F(Estimate, PhotosOfAZoomLensAreMappedAgainEachWithItsCamera) {
  const ColmapCamera camera{1, CameraModel::kSimpleRadial, 64, 48, {55, 32, 24, -0.05}};
  ColmapModel model = ZoomedRing(camera, 8, 1500, 0.03, 0.1);
  for (auto& [id, image] : model.images) image.name = WorkingPhotoName(capture_.images[id - 1]);
  ColmapModel own = model;
  for (auto& [id, image] : own.images) {
    image.camera_id = 50 + id;
    own.cameras[50 + id] = {50 + id, CameraModel::kSimpleRadial, 64, 48, {55 * ZoomOf(id, 8, 0.1), 32, 24, -0.05}};
  }
  own.cameras.erase(1);
  for (int i = 0; i < 400; ++i) {  // the mapper with a shared camera lost these
    const auto point = std::prev(model.points.end());
    for (const auto& [image, index] : point->second.track) model.images.at(image).observations[index].point_id = -1;
    model.points.erase(point);
  }
  AddModel(0, model, "models");
  AddModel(0, own, "own");
  const Manifest manifest = Run();
  EXPECT_TRUE(Decided(manifest, "own_focal_lengths"));
  EXPECT_EQ(manifest.facts.at("n_points"), 1500);
  EXPECT_EQ(manifest.facts.at("attempts").back().at("settings"), "thorough, own focal lengths");
  EXPECT_EQ(manifest.facts.at("attempts").back().at("n_pairs"), 0);
  EXPECT_EQ(manifest.facts.at("models").at(0).at("n_points"), 1500);
  const ColmapModel found = ReadColmapModel(sfm_ / "sparse");
  for (const auto& [id, image] : found.images)
    EXPECT_NEAR(found.cameras.at(image.camera_id).params[0], 55 * ZoomOf(id, 8, 0.1), 0.2);
  EXPECT_EQ(ReadColmapModel(sfm_ / "mapping/model").points.size(), 1100u);
  // Not where it fails, gains next to no points, or loses photos.
  WriteFileAtomically(fake_ / "own.fails", "");
  EXPECT_EQ(Run().facts.at("n_points"), 1100);
  fs::remove(fake_ / "own.fails");
  for (const bool photos : {false, true}) {
    ColmapModel less = own;
    if (photos) {
      less.images.erase(8);
      for (auto& [id, point] : less.points) std::erase_if(point.track, [](const auto& o) { return o.first == 8; });
    } else {
      while (less.points.size() > 1130) less.points.erase(std::prev(less.points.end()));
      for (auto& [id, image] : less.images) {
        for (ColmapObservation& seen : image.observations) {
          if (!less.points.contains(uint64_t(seen.point_id))) seen.point_id = -1;
        }
      }
    }
    fs::remove_all(fake_ / "own");
    AddModel(0, less, "own");
    const Manifest kept = Run();
    EXPECT_EQ(kept.facts.at("n_points"), 1100) << photos;
    EXPECT_TRUE(Decided(kept, "own_focal_lengths"));
    EXPECT_THAT(kept.decisions.back().evidence, HasSubstr("not taken"));
  }
}

TEST_F(Estimate, OwnCamerasAreWrittenIntoTheDatabaseAndMatchesStay) {
  const ColmapCamera own{0, CameraModel::kRadial, 64, 48, {45, 32, 24, -0.25, 0.3}};
  SetOwnCameras(fake_ / "database.db", {{2, own}, {5, own}});
  const ColmapDatabase database = ReadColmapDatabase(fake_ / "database.db");
  EXPECT_EQ(database.verified_matches.size(), 28u);
  EXPECT_EQ(database.images.at(1).camera_id, 1u);
  EXPECT_EQ(database.images.at(2).camera_id, 2u);
  EXPECT_EQ(database.images.at(5).camera_id, 3u);
}

TEST_F(Estimate, RigsOfNewerColmapsAreMadeAnewForOwnCameras) {
  const fs::path file = fake_ / "database.db";
  sqlite3* connection = nullptr;
  ASSERT_EQ(sqlite3_open(file.c_str(), &connection), SQLITE_OK);
  ASSERT_EQ(sqlite3_exec(connection,
                         "CREATE TABLE rigs (rig_id INTEGER); INSERT INTO rigs VALUES (1);"
                         "CREATE TABLE frames (frame_id INTEGER); INSERT INTO frames VALUES (1);",
                         nullptr, nullptr, nullptr),
            SQLITE_OK);
  SetOwnCameras(file, {{2, {0, CameraModel::kRadial, 64, 48, {45, 32, 24, -0.25, 0.3}}}});
  sqlite3_stmt* row = nullptr;
  sqlite3_prepare_v2(connection, "SELECT (SELECT count(*) FROM rigs) + (SELECT count(*) FROM frames)", -1, &row,
                     nullptr);
  ASSERT_EQ(sqlite3_step(row), SQLITE_ROW);
  EXPECT_EQ(sqlite3_column_int(row, 0), 0);
  sqlite3_finalize(row);
  sqlite3_close(connection);
}

// Only where a zoom can be made up for may it keep richer lenses away.
TEST_F(Estimate, FocalLengthsThatAreNotToBeKeepNoLensAway) {
  EstimateOptions options;
  EXPECT_TRUE(MayHaveOwnFocalLengths(20, options));
  EXPECT_FALSE(MayHaveOwnFocalLengths(501, options));
  options.refine = false;
  EXPECT_FALSE(MayHaveOwnFocalLengths(20, options));
  options.own_focal_lengths = true;
  EXPECT_TRUE(MayHaveOwnFocalLengths(501, options));
  options.own_focal_lengths = false;
  options.refine = true;
  EXPECT_FALSE(MayHaveOwnFocalLengths(20, options));
}

TEST_F(Estimate, FocalLengthsCanBeForcedWhereThereIsTooLittleToTellBy) {
  AddModel(0, {0, 1, 2, 3, 4, 5, 6, 7});
  Manifest manifest = Run();
  EXPECT_FALSE(Decided(manifest, "own_focal_lengths"));
  EXPECT_THAT(manifest.decisions.back().evidence, HasSubstr("too few observations"));
  EstimateOptions options;
  options.own_focal_lengths = true;
  manifest = Run(options);
  EXPECT_TRUE(Decided(manifest, "own_focal_lengths"));
  EXPECT_EQ(manifest.decisions.back().reason, "forced by an option");
  EXPECT_EQ(ReadColmapModel(sfm_ / "sparse").cameras.size(), 8u);
}

TEST_F(Estimate, WhatIsForcedInVainIsSaid) {
  AddModel(0, {0, 1, 2, 3, 4, 5, 6, 7});
  EstimateOptions options;
  options.gps_pairs = true;
  const Manifest manifest = Run(options);
  EXPECT_FALSE(Decided(manifest, "gps_pairs"));
  EXPECT_THAT(manifest.decisions.at(1).evidence, "all pairs are matched");
  options = {};
  options.second_attempt = true;
  options.max_features = 100;
  fs::remove_all(sfm_);
  ExpectError(ExitCode::kUsage, HasSubstr("leave either --second-attempt on out"), options);
}

TEST_F(Estimate, WorkingPhotosOfAnotherOrientationAreAnError) {
  std::vector<std::string> names;
  for (const CaptureImage& photo : capture_.images) names.push_back(WorkingPhotoName(photo));
  AddModel(0, MakeModel(names, 24, 32, -0.05), "models");
  ExpectError(ExitCode::kCorrupt, AllOf(HasSubstr("photo 000000 24×32, its sensor 64×48"), HasSubstr("partial")));
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
  // Certified as one camera, as it was solved: each turn's own would have had too few images for a principal point.
  EXPECT_EQ(ReadJson(sfm_ / kRefinementName).at("n_principal_points_held"), 0);
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
