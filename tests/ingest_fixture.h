// What the tests of ingest share: a made-up capture, the run, its result.
#pragma once

#include <gmock/gmock.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <map>
#include <numbers>
#include <string>

#include "pipeline/error.h"
#include "pipeline/json.h"
#include "pipeline/manifest.h"
#include "sfm/capture.h"
#include "sfm/colmap_model.h"
#include "sfm/ingest.h"
#include "tests/photo_fixtures.h"
#include "tests/temporary_directory.h"

namespace nrff {

class IngestTest : public ::testing::Test {
 protected:
  void Write(const std::filesystem::path& name, const std::string& bytes) {
    std::filesystem::create_directories((root_ / name).parent_path());
    std::ofstream(root_ / name, std::ios::binary | std::ios::trunc)
        .write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
  }

  // n photos that differ, DIR/photo_00.png …
  void WritePhotos(int n, const std::string& stem = "photo_", PhotoOptions options = {}) {
    for (int i = 0; i < n; ++i) {
      options.seed = static_cast<uint32_t>(i + 1);
      WritePhoto(root_ / (stem + std::to_string(i / 10) + std::to_string(i % 10) + ".png"), options);
    }
  }

  Capture RunIngest(IngestOptions options = {}) {
    const std::filesystem::path out = work_.path() / "ingest";
    ArtifactWriter artifact("ingest", out, {}, {CaptureInput(root_)});
    options.n_threads = 2;
    Ingest(root_, options, artifact);
    artifact.Commit();
    manifest_ = RequireArtifact(out, "ingest");
    model_ = std::filesystem::exists(out / kGivenModelDir) ? ReadColmapModel(out / kGivenModelDir) : ColmapModel{};
    return LoadCapture(out);
  }

  std::string ErrorOf() {
    try {
      RunIngest();
    } catch (const Error& error) {
      EXPECT_EQ(error.code(), ExitCode::kInput);
      return error.what();
    }
    ADD_FAILURE() << "ingested without an error";
    return {};
  }

  // A 4×4 camera-to-world matrix in JSON: OpenGL axes, camera i of a ring that looks at the origin.
  static Json RingPose(int i, int n) {
    const double angle = 2 * std::numbers::pi * i / n, s = std::sin(angle), c = std::cos(angle);
    return {{c, 0, s, 3 * s}, {0, 1, 0, 0.5}, {-s, 0, c, 3 * c}, {0, 0, 0, 1}};
  }

  static Json RingFrames(int n, const std::string& stem, const std::string& extension = ".png") {
    Json frames = Json::array();
    for (int i = 0; i < n; ++i) {
      frames.push_back({{"file_path", stem + std::to_string(i / 10) + std::to_string(i % 10) + extension},
                        {"transform_matrix", RingPose(i, n)}});
    }
    return frames;
  }

  static std::map<std::string, Split> Splits(const Capture& capture) {
    std::map<std::string, Split> splits;
    for (const CaptureImage& image : capture.images) splits[image.Name()] = image.split;
    return splits;
  }

  TemporaryDirectory capture_dir_, work_;
  std::filesystem::path root_ = capture_dir_.path() / "cap";
  Manifest manifest_;
  ColmapModel model_;
};

}  // namespace nrff
