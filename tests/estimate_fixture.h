// Estimates of poses with a COLMAP made of a shell script.
#pragma once

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sqlite3.h>

#include <cstdlib>
#include <filesystem>
#include <functional>
#include <string>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "sfm/estimate.h"
#include "sfm/image_pairs.h"
#include "sfm/ingest.h"
#include "sfm/working_photos.h"
#include "tests/pose_fixture.h"
#include "tests/temporary_directory.h"

namespace nrff {

namespace fs = std::filesystem;

// Answers as COLMAP 3.8, unless $FAKE/COMMAND is a script to run instead. Every call is written to $FAKE/calls. The
// database and the models it "computes" are those that lie in $FAKE.
inline constexpr char kFakeColmap[] = R"sh(#!/bin/sh
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
    models="$FAKE/$(basename "$output")"  # models, joined, lenses, own
    [ -e "$models.fails" ] && exit 1
    cp -r "$models"/. "$output"; echo "Registering image #1 (3)"
    ;;
esac
)sh";

inline constexpr char kHelp38[] =
    "--database_path arg\n--image_path arg\n--input_path arg\n--output_path arg\n--image_list_path arg\n"
    "--match_list_path arg\n--random_seed arg\n"
    "--ImageReader.camera_model arg\n--ImageReader.camera_params arg\n"
    "--SiftExtraction.use_gpu arg\n--SiftExtraction.peak_threshold arg\n--SiftMatching.use_gpu "
    "arg\n--Mapper.min_model_size arg\n";
inline constexpr char kHelp313[] =
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

}  // namespace nrff
