#include "sfm/colmap_model.h"

#include <gmock/gmock.h>

#include <cmath>
#include <cstdlib>
#include <fstream>
#include <limits>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "tests/temporary_directory.h"

namespace nrff {
namespace {

using ::testing::HasSubstr;
namespace fs = std::filesystem;

class ColmapModelTest : public ::testing::Test {
 protected:
  static ColmapModel SmallModel() {
    ColmapModel model;
    model.cameras[3] = {3, CameraModel::kOpenCV, 640, 480, {500.25, 501.5, 320, 240, 0.1, -0.05, 1e-3, -2e-17}};
    model.cameras[9] = {9, CameraModel::kSimplePinhole, 100, 200, {90, 50, 100}};
    ColmapImage first{7, 3, "a photo with spaces.jpg", Eigen::Quaterniond(0.5, 0.5, -0.5, 0.5), {1, -2, 1.0 / 3}, {}};
    first.observations = {{10.5, 20.25, 12}, {1, 2, -1}};
    model.images[7] = first;
    model.images[11] = {11, 9, "b.png", Eigen::Quaterniond::Identity(), {0, 0, 0}, {}};
    model.points[12] = {{0.1, 0.2, -0.3}, {255, 0, 17}, 0.75, {{7, 0}}};
    return model;
  }

  static void ExpectEqual(const ColmapModel& a, const ColmapModel& b) {
    ASSERT_EQ(a.cameras.size(), b.cameras.size());
    for (const auto& [id, camera] : a.cameras) {
      const ColmapCamera& other = b.cameras.at(id);
      EXPECT_EQ(camera.model, other.model);
      EXPECT_EQ(camera.width, other.width);
      EXPECT_EQ(camera.height, other.height);
      EXPECT_EQ(camera.params, other.params);
    }
    ASSERT_EQ(a.images.size(), b.images.size());
    for (const auto& [id, image] : a.images) {
      const ColmapImage& other = b.images.at(id);
      EXPECT_EQ(image.camera_id, other.camera_id);
      EXPECT_EQ(image.name, other.name);
      EXPECT_LT((image.rotation.coeffs() - other.rotation.coeffs()).norm(), 1e-15);
      EXPECT_EQ(image.translation, other.translation);
      ASSERT_EQ(image.observations.size(), other.observations.size());
      for (size_t i = 0; i < image.observations.size(); ++i) {
        EXPECT_EQ(image.observations[i].x, other.observations[i].x);
        EXPECT_EQ(image.observations[i].y, other.observations[i].y);
        EXPECT_EQ(image.observations[i].point_id, other.observations[i].point_id);
      }
    }
    ASSERT_EQ(a.points.size(), b.points.size());
    for (const auto& [id, point] : a.points) {
      const ColmapPoint& other = b.points.at(id);
      EXPECT_EQ(point.position, other.position);
      EXPECT_EQ(point.rgb, other.rgb);
      EXPECT_EQ(point.error_px, other.error_px);
      EXPECT_EQ(point.track, other.track);
    }
  }

  static void Write(const fs::path& path, const std::string& bytes) {
    std::ofstream(path, std::ios::binary | std::ios::trunc).write(bytes.data(), bytes.size());
  }

  // The text of the InputError that reading `dir_` ends with.
  std::string ReadError() {
    try {
      ReadColmapModel(dir_);
    } catch (const Error& error) {
      EXPECT_EQ(error.code(), ExitCode::kInput);
      return error.what();
    }
    ADD_FAILURE() << "read without an error";
    return {};
  }

  TemporaryDirectory holder_;
  const fs::path dir_ = holder_.path();
};

TEST_F(ColmapModelTest, BinaryReadsBackAsWritten) {
  WriteColmapBinary(SmallModel(), dir_);
  ExpectEqual(SmallModel(), ReadColmapModel(dir_));
}

TEST_F(ColmapModelTest, TextReadsBackAsWrittenInFullPrecision) {
  WriteColmapText(SmallModel(), dir_);
  ExpectEqual(SmallModel(), ReadColmapModel(dir_));
}

TEST_F(ColmapModelTest, BinaryTruncatedAtEveryByteIsAnInputErrorThatNamesTheFile) {
  WriteColmapBinary(SmallModel(), dir_);
  for (const char* name : {"cameras.bin", "images.bin", "points3D.bin"}) {
    const std::string whole = ReadFile(dir_ / name);
    for (size_t length = 0; length < whole.size(); ++length) {
      Write(dir_ / name, whole.substr(0, length));
      EXPECT_THAT(ReadError(), HasSubstr(name)) << "cut to " << length << " bytes";
    }
    Write(dir_ / name, whole);
  }
}

TEST_F(ColmapModelTest, TextTruncatedAtEveryByteIsReadOrRefused) {
  WriteColmapText(SmallModel(), dir_);
  for (const char* name : {"cameras.txt", "images.txt", "points3D.txt"}) {
    const std::string whole = ReadFile(dir_ / name);
    for (size_t length = 0; length < whole.size(); ++length) {
      Write(dir_ / name, whole.substr(0, length));
      try {
        ReadColmapModel(dir_);
      } catch (const Error& error) {
        EXPECT_EQ(error.code(), ExitCode::kInput) << error.what();
      }
    }
    Write(dir_ / name, whole);
  }
}

TEST_F(ColmapModelTest, AbsurdCountsAreRefusedBeforeMemoryIsTaken) {
  WriteColmapBinary(SmallModel(), dir_);
  for (const char* name : {"cameras.bin", "images.bin", "points3D.bin"}) {
    const std::string whole = ReadFile(dir_ / name);
    Write(dir_ / name, std::string(7, '\xff') + '\x7f' + whole.substr(8));
    EXPECT_THAT(ReadError(), HasSubstr("records follow"));
    Write(dir_ / name, whole);
  }
}

TEST_F(ColmapModelTest, AnUnknownCameraModelIsRefused) {
  Write(dir_ / "cameras.txt", "1 PANORAMA 10 10 1 2 3\n");
  EXPECT_THAT(ReadError(), HasSubstr("PANORAMA"));
}

TEST_F(ColmapModelTest, ANonFinitePoseIsRefusedWithTheImagesName) {
  for (double bad : {std::nan(""), std::numeric_limits<double>::infinity()}) {
    ColmapModel model = SmallModel();
    model.images[11].translation.y() = bad;
    WriteColmapBinary(model, dir_);
    EXPECT_THAT(ReadError(), HasSubstr("b.png"));
  }
  ColmapModel model = SmallModel();
  model.images[11].rotation.coeffs().setZero();
  WriteColmapBinary(model, dir_);
  EXPECT_THAT(ReadError(), HasSubstr("b.png"));
}

TEST_F(ColmapModelTest, AnImageWithoutItsCameraIsRefused) {
  ColmapModel model = SmallModel();
  model.images[11].camera_id = 5;
  WriteColmapBinary(model, dir_);
  EXPECT_THAT(ReadError(), HasSubstr("camera 5"));
}

TEST_F(ColmapModelTest, ATrackToAnObservationThatIsNotThereIsRefused) {
  for (std::pair<uint32_t, uint32_t> element : {std::pair{99u, 0u}, std::pair{7u, 2u}}) {
    ColmapModel model = SmallModel();
    model.points[12].track.push_back(element);
    WriteColmapBinary(model, dir_);
    EXPECT_THAT(ReadError(), HasSubstr("track of point 12"));
  }
}

TEST_F(ColmapModelTest, AFolderWithoutAModelIsRefused) { EXPECT_THAT(ReadError(), HasSubstr("no COLMAP model")); }

TEST_F(ColmapModelTest, ANameThatTextCannotHoldIsRefusedInTextOnly) {
  ColmapModel model = SmallModel();
  model.images[7].name = "two\nlines.jpg";
  EXPECT_THROW(WriteColmapText(model, dir_), Error);
  WriteColmapBinary(model, dir_);
  EXPECT_EQ(ReadColmapModel(dir_).images.at(7).name, "two\nlines.jpg");
}

fs::path DataDir() {
  const char* given = std::getenv("NRFF_DATA");
  return given ? fs::path(given) : fs::path(NRFF_SOURCE_DIR) / "../shared/data";
}

TEST_F(ColmapModelTest, ModelsMadeByColmapAreReadAndSurviveBothEncodings) {
  struct {
    const char* name;
    size_t n_images;
    CameraModel model;
  } const kCases[] = {{"cup_simple_pinhole", 77, CameraModel::kSimplePinhole},
                      {"figurine_simple_radial", 23, CameraModel::kSimpleRadial}};
  if (!fs::exists(DataDir() / "colmap_models")) GTEST_SKIP() << "no " << DataDir() << "; set NRFF_DATA";
  for (const auto& expected : kCases) {
    const ColmapModel model = ReadColmapModel(DataDir() / "colmap_models" / expected.name / "sparse/0");
    EXPECT_EQ(model.images.size(), expected.n_images);
    EXPECT_EQ(model.cameras.begin()->second.model, expected.model);
    EXPECT_GT(model.points.size(), 100u);
    WriteColmapBinary(model, dir_ / expected.name / "binary");
    ExpectEqual(model, ReadColmapModel(dir_ / expected.name / "binary"));
    WriteColmapText(model, dir_ / expected.name / "text");
    ExpectEqual(model, ReadColmapModel(dir_ / expected.name / "text"));
  }
}

}  // namespace
}  // namespace nrff
