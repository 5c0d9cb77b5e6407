// Captures that bring their poses: transforms.json, NSVF, COLMAP.
#include <gmock/gmock.h>

#include <functional>
#include <set>
#include <tuple>

#include "sfm/transforms_json.h"
#include "tests/ingest_fixture.h"

namespace nrff {
namespace {

using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
namespace fs = std::filesystem;

TEST_F(IngestTest, NerfSyntheticIsReadWithItsOwnSplitAndBox) {
  WritePhotos(5, "train/r_", {.channels = 4});
  WritePhotos(2, "test/r_", {.channels = 4, .alpha = 7});
  WritePhotos(2, "val/r_", {.channels = 4, .alpha = 9});
  for (const auto& [split, n] : std::map<std::string, int>{{"train", 5}, {"test", 2}, {"val", 2}}) {
    Write("transforms_" + split + ".json",
          Json{{"camera_angle_x", 0.6911112}, {"frames", RingFrames(n, "./" + split + "/r_", "")}}.dump());
  }
  const Capture capture = RunIngest();
  EXPECT_EQ(capture.kind, "transforms");
  EXPECT_EQ(capture.split_rule, "the data set's own");
  EXPECT_EQ(manifest_.facts["n_train"], 5);
  EXPECT_EQ(manifest_.facts["n_test"], 2);
  EXPECT_EQ(capture.background, Background::kWhite);
  ASSERT_TRUE(capture.box);
  EXPECT_NEAR((*capture.box)[0], -1.5 * 3 / 4.0311, 1e-9) << "cameras are 3 units away";
  ASSERT_EQ(model_.cameras.size(), 1u);
  const ColmapCamera& camera = model_.cameras.begin()->second;
  EXPECT_EQ(camera.model, CameraModel::kPinhole);
  EXPECT_NEAR(camera.params[0], 24 / std::tan(0.6911112 / 2), 1e-9);
  EXPECT_EQ(camera.params[2], 24);
  EXPECT_EQ(camera.params[3], 16);
  EXPECT_FALSE(manifest_.decisions[0].needed);
}

TEST_F(IngestTest, NerfSyntheticsBoxGoesWithTheWorld) {
  WritePhotos(3, "r_", {.channels = 4});
  std::array<double, 6> given{};
  for (const auto& [scale, shift] : {std::pair{1., 0.}, {1e-4, 0.}, {1e4, 0.}, {1., 1e6}}) {
    Json frames = RingFrames(3, "r_");
    for (Json& frame : frames) {
      for (int row = 0; row < 3; ++row) {
        Json& x = frame["transform_matrix"][row][3];
        x = scale * x.get<double>() + shift;
      }
    }
    Write("transforms.json", Json{{"camera_angle_x", 0.7}, {"frames", frames}}.dump());
    const auto box = RunIngest().box;
    ASSERT_TRUE(box) << scale << " " << shift;
    if (scale == 1 && shift == 0) given = *box;
    for (int i = 0; i < 6; ++i) {
      EXPECT_NEAR((*box)[i], scale * given[i] + shift, 1e-9 * scale + 1e-15 * shift) << scale << " " << shift;
    }
  }
}

TEST_F(IngestTest, OpenGlPosesBecomeOpenCvs) {
  WritePhotos(3);
  Write("transforms.json", Json{{"camera_angle_x", 0.8}, {"frames", RingFrames(3, "photo_")}}.dump());
  const Capture capture = RunIngest();
  ASSERT_EQ(model_.images.size(), 3u);
  for (const auto& [id, image] : model_.images) {
    // Every camera of the ring looks at the height 0.5 over the origin, 3 units in front of it; y down is world −y.
    const Eigen::Vector3d seen = image.rotation * Eigen::Vector3d(0, 0.5, 0) + image.translation;
    EXPECT_LT((seen - Eigen::Vector3d(0, 0, 3)).norm(), 1e-12);
    EXPECT_LT((image.rotation * Eigen::Vector3d(0, 1, 0) - Eigen::Vector3d(0, -1, 0)).norm(), 1e-12);
  }
  EXPECT_EQ(model_.images.begin()->second.name, "000000");
}

TEST_F(IngestTest, InstantNgpDistortionIsReadAndMissingFramesAreListed) {
  WritePhotos(4, "images/photo_");
  Json frames = RingFrames(6, "images/photo_");
  Write("transforms.json", Json{{"fl_x", 50.5},
                                {"fl_y", 51.5},
                                {"cx", 24.5},
                                {"cy", 15.5},
                                {"w", 48.0},
                                {"h", 32.0},
                                {"k1", 0.1},
                                {"k2", -0.2},
                                {"p1", 1e-3},
                                {"p2", 2e-3},
                                {"aabb_scale", 4},
                                {"frames", frames}}
                               .dump());
  const Capture capture = RunIngest();
  EXPECT_EQ(capture.images.size(), 4u);
  ASSERT_EQ(capture.rejected.size(), 2u);
  EXPECT_EQ(capture.rejected[0].name, "images/photo_04.png");
  EXPECT_THAT(capture.rejected[0].reason, HasSubstr("does not exist"));
  EXPECT_FALSE(capture.box);
  const ColmapCamera& camera = model_.cameras.begin()->second;
  EXPECT_EQ(camera.model, CameraModel::kOpenCV);
  EXPECT_THAT(camera.params, ElementsAre(50.5, 51.5, 24.5, 15.5, 0.1, -0.2, 1e-3, 2e-3));
}

TEST_F(IngestTest, NoneOfTheFramesExistingIsAnError) {
  WritePhotos(3);
  Write("transforms.json", Json{{"camera_angle_x", 0.8}, {"frames", RingFrames(3, "elsewhere/")}}.dump());
  EXPECT_THAT(ErrorOf(), AllOf(HasSubstr("none of the 3 frames"), HasSubstr("elsewhere/00.png")));
}

TEST_F(IngestTest, SplitsThatNameNoFrameAreAnError) {
  WritePhotos(3);
  Write("transforms.json", Json{{"camera_angle_x", 0.8},
                                {"frames", RingFrames(3, "photo_")},
                                {"train_filenames", {"elsewhere/00.png"}},
                                {"test_filenames", {"elsewhere/01.png"}}}
                               .dump());
  EXPECT_THAT(ErrorOf(), AllOf(HasSubstr("none of the 3 frames"), HasSubstr("train_filenames")));
}

TEST_F(IngestTest, NerfstudioIntrinsicsPerFrameSplitsAndAppliedTransformAreUnderstood) {
  WritePhotos(4);
  Json frames = RingFrames(4, "photo_");
  for (Json& frame : frames) frame.update({{"fl_x", 60}, {"fl_y", 60}, {"cx", 24}, {"cy", 16}, {"w", 48}, {"h", 32}});
  frames[1].update({{"fl_x", 70}, {"camera_model", "OPENCV_FISHEYE"}, {"k1", 0.01}});
  const Json swap = {{0, 1, 0, 0}, {0, 0, 1, 0}, {1, 0, 0, 2}};
  Write("transforms.json", Json{{"frames", frames},
                                {"applied_transform", swap},
                                {"applied_scale", 2.0},
                                {"train_filenames", {"photo_00.png", "photo_01.png", "photo_02.png"}},
                                {"test_filenames", {"photo_03.png"}}}
                               .dump());
  const Capture capture = RunIngest();
  EXPECT_EQ(capture.split_rule, "the data set's own");
  EXPECT_EQ(capture.images[3].split, Split::kTest);
  EXPECT_EQ(model_.cameras.size(), 2u);
  EXPECT_EQ(model_.cameras.at(model_.images.at(2).camera_id).model, CameraModel::kOpenCVFisheye);
  // In the file the first camera is at (0, 0.5, 3): at half scale (0, 0.25, 1.5), moved back (0, 0.25, −0.5), axes
  // back.
  EXPECT_LT((model_.images.at(1).Center() - Eigen::Vector3d(-0.5, 0, 0.25)).norm(), 1e-12);
}

TEST_F(IngestTest, ResizedPhotosGetResizedCameras) {
  WritePhotos(3);
  Write("transforms.json",
        Json{{"fl_x", 100.0}, {"cx", 50.0}, {"cy", 30.0}, {"w", 96}, {"h", 64}, {"frames", RingFrames(3, "photo_")}}
            .dump());
  RunIngest();
  const ColmapCamera& camera = model_.cameras.begin()->second;
  EXPECT_EQ(camera.width, 48);
  EXPECT_THAT(camera.params, ElementsAre(50, 50, 25, 15));
}

TEST_F(IngestTest, PhotosOfAnotherShapeThanTheirCameraAreRejected) {
  WritePhotos(4);
  WritePhoto(root_ / "photo_02.png", {.width = 48, .height = 48, .seed = 77});
  Write("transforms.json", Json{{"fl_x", 100.0}, {"w", 96}, {"h", 64}, {"frames", RingFrames(4, "photo_")}}.dump());
  const Capture capture = RunIngest();
  ASSERT_EQ(capture.rejected.size(), 1u);
  EXPECT_EQ(capture.rejected[0].name, "photo_02.png");
}

TEST_F(IngestTest, BadPosesAreErrorsThatNameFileAndFrame) {
  WritePhotos(3);
  auto error_with = [&](const std::function<void(Json&)>& spoil) {
    Json frames = RingFrames(3, "photo_");
    spoil(frames[1]["transform_matrix"]);
    std::string text = Json{{"camera_angle_x", 0.8}, {"frames", frames}}.dump();
    if (const size_t at = text.find("\"nan\""); at != std::string::npos)
      text.replace(at, 5, "NaN");  // as Python writes it
    Write("transforms.json", text);
    return ErrorOf();
  };
  const auto names_frame = AllOf(HasSubstr("transforms.json"), HasSubstr("photo_01.png"));
  EXPECT_THAT(error_with([](Json& m) { m[0][3] = "nan"; }), AllOf(names_frame, HasSubstr("NaN")));
  EXPECT_THAT(error_with([](Json& m) {
                for (int i = 0; i < 3; ++i) m[i][0] = -m[i][0].get<double>();
              }),
              AllOf(names_frame, HasSubstr("left-handed")));
  EXPECT_THAT(error_with([](Json& m) { m[1][1] = 1.1; }), AllOf(names_frame, HasSubstr("not a rotation")));
  EXPECT_THAT(error_with([](Json& m) { m[1] = "x"; }), names_frame);
  EXPECT_THAT(error_with([](Json& m) {
                m.erase(1);
                m.erase(1);
              }),
              names_frame);
}

TEST_F(IngestTest, DamagedTransformsFilesAreErrorsThatNameTheFile) {
  WritePhotos(3);
  for (const char* text :
       {"", "{", "[]", "{\"frames\": []}", "{\"frames\": [{}]}", "{\"frames\": [{\"file_path\": 3}]}"}) {
    Write("transforms.json", text);
    EXPECT_THAT(ErrorOf(), HasSubstr("transforms.json")) << text;
  }
}

TEST_F(IngestTest, TransformsReadBackAsWritten) {
  WritePhotos(3);
  ColmapModel model;
  model.cameras[1] = {1, CameraModel::kOpenCV, 48, 32, {50, 51, 24, 16, 0.1, 0.2, 0.3, 0.4}};
  model.cameras[2] = {2, CameraModel::kSimplePinhole, 48, 32, {60, 24, 16}};
  for (uint32_t i = 1; i <= 3; ++i) {
    model.images[i] = {i,
                       i == 2 ? 2u : 1u,
                       "photo_0" + std::to_string(i - 1) + ".png",
                       Eigen::Quaterniond(1, 0.1 * i, -0.2, 0.3).normalized(),
                       {1.0 * i, 2, -3},
                       {}};
  }
  Eigen::Matrix<double, 3, 4> applied;
  applied << 0, 1, 0, 0.5, 0, 0, 1, -1, 1, 0, 0, 2;
  WriteTransforms(model, root_ / "transforms.json", applied, 0.25);
  const Source source = *ReadTransformsSource(root_);
  ASSERT_TRUE(source.model);
  ASSERT_EQ(source.model->images.size(), 3u);
  for (const auto& [id, image] : source.model->images) {
    EXPECT_EQ(image.name, model.images.at(id).name);
    EXPECT_LT(image.rotation.angularDistance(model.images.at(id).rotation), 1e-12);
    EXPECT_LT((image.translation - model.images.at(id).translation).norm(), 1e-12);
  }
  EXPECT_EQ(source.model->cameras.at(1).params, model.cameras.at(1).params);
  EXPECT_THAT(source.model->cameras.at(2).params, ElementsAre(60, 60, 24, 16));
}

TEST_F(IngestTest, APhotoOfTheTrainingSetIsNotHeldOutAsWell) {
  WritePhotos(5);
  Json test = RingFrames(5, "photo_");
  test.erase(0);
  test.erase(0);
  Write("transforms_train.json", Json{{"camera_angle_x", 0.8}, {"frames", RingFrames(4, "photo_")}}.dump());
  Write("transforms_test.json", Json{{"camera_angle_x", 0.8}, {"frames", test}}.dump());
  const Capture capture = RunIngest();
  EXPECT_EQ(capture.images.size(), 5u);
  EXPECT_EQ(manifest_.facts["n_test"], 1);
  ASSERT_EQ(capture.rejected.size(), 2u);
  EXPECT_THAT(capture.rejected[0].reason, HasSubstr("named twice"));
  EXPECT_EQ(model_.images.size(), 5u);
}

class NsvfTest : public IngestTest {
 protected:
  void WriteNsvf(const std::vector<std::string>& names) {
    uint32_t seed = 0;
    for (const std::string& name : names) {
      WritePhoto(root_ / "rgb" / (name + ".png"), {.seed = ++seed});
      Write("pose/" + name + ".txt", "1 0 0 " + std::to_string(seed) + "\n0 1 0 0\n0 0 1 -2\n0 0 0 1\n");
    }
    Write("intrinsics.txt", "60 0 24 0\n0 61 16 0\n0 0 1 0\n0 0 0 1\n");
    Write("bbox.txt", "-1 -2 -3 1 2 5 0.4");
  }
};

TEST_F(NsvfTest, TheLayoutIsReadWithBoxAndWhiteBackground) {
  WriteNsvf({"0_a", "0_b", "0_c", "1_d", "2_e"});
  const Capture capture = RunIngest();
  EXPECT_EQ(capture.kind, "nsvf");
  EXPECT_EQ(capture.background, Background::kWhite);
  ASSERT_TRUE(capture.box);
  const std::array<double, 6> expected = {-1.2, -2.4, -3.8, 1.2, 2.4, 5.8};
  for (int i = 0; i < 6; ++i) EXPECT_NEAR((*capture.box)[i], expected[i], 1e-12);
  EXPECT_EQ(capture.images.size(), 4u);  // validation views are not used where there are test views
  EXPECT_EQ(Splits(capture).at("2_e.png"), Split::kTest);
  EXPECT_EQ(model_.images.at(1).Center(), Eigen::Vector3d(1, 0, -2));
  EXPECT_THAT(model_.cameras.begin()->second.params, ElementsAre(60, 61, 24, 16));
}

TEST_F(NsvfTest, ValidationIsTestWhereThereIsNoTest) {
  WriteNsvf({"0_a", "0_b", "1_d"});
  const Capture capture = RunIngest();
  EXPECT_EQ(capture.split_rule, "the data set's own");
  EXPECT_EQ(Splits(capture).at("1_d.png"), Split::kTest);
}

TEST_F(NsvfTest, NamesWithoutPrefixAreHeldOutByName) {
  WriteNsvf({"a", "b", "0_c"});
  EXPECT_EQ(RunIngest().split_rule, "every 8th by file name");
}

TEST_F(NsvfTest, AllFormsOfIntrinsicsAreRead) {
  WriteNsvf({"0_a", "0_b", "1_d"});
  for (const char* text :
       {"60 24 16", "60. 24. 16. 0.\n", "60 24 16 0.\n0. 0. 0.\n0.\n1.\n32 48\n", "60 0 24 0 60 16 0 0 1"}) {
    Write("intrinsics.txt", text);
    RunIngest();
    EXPECT_THAT(model_.cameras.begin()->second.params, ElementsAre(60, 60, 24, 16)) << text;
  }
  Write("intrinsics.txt", "120 48 32 0.\n0. 0. 0.\n0.\n1.\n64 96\n");  // for photos of twice the size
  RunIngest();
  EXPECT_THAT(model_.cameras.begin()->second.params, ElementsAre(60, 60, 24, 16));
}

TEST_F(NsvfTest, BadFilesAreErrorsThatNameThem) {
  const std::map<std::string, std::string> spoiled = {
      {"pose/0_b.txt", "1 0 0 nan 0 1 0 0 0 0 1 0 0 0 0 1"}, {"intrinsics.txt", "1 2"}, {"bbox.txt", "1 1 1 0 0 0"}};
  for (const auto& [name, text] : spoiled) {
    WriteNsvf({"0_a", "0_b", "1_d"});
    Write(name, text);
    EXPECT_THAT(ErrorOf(), HasSubstr(name));
  }
  WriteNsvf({"0_a", "0_b", "1_d"});
  for (const char* text : {"-1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "1 0 0 0 0 1", "1 0 0 0 0 1 0 0 x"}) {
    Write("pose/0_b.txt", text);
    EXPECT_THAT(ErrorOf(), HasSubstr("0_b.txt")) << text;
  }
}

TEST_F(NsvfTest, PhotosWithoutPoseAndPosesWithoutPhotoAreListed) {
  WriteNsvf({"0_a", "0_b", "0_c", "1_d"});
  fs::remove(root_ / "pose/0_b.txt");
  fs::remove(root_ / "rgb/0_c.png");
  WritePhoto(root_ / "rgb/0_e.png", {.seed = 70});
  fs::copy_file(root_ / "pose/0_a.txt", root_ / "pose/0_e.txt");
  const Capture capture = RunIngest();
  std::set<std::string> rejected;
  for (const RejectedFile& file : capture.rejected) rejected.insert(file.name);
  EXPECT_THAT(rejected, ElementsAre("rgb/0_b.png", "rgb/0_c"));
}

class ColmapCaptureTest : public IngestTest {
 protected:
  // Cameras twice as large as the photos, to see that they are scaled.
  void WriteModel(const std::string& dir, int n_images) {
    ColmapModel model;
    model.cameras[4] = {4, CameraModel::kSimpleRadial, 96, 64, {120, 48, 32, 0.01}};
    for (uint32_t i = 0; i < static_cast<uint32_t>(n_images); ++i) {
      model.images[10 + i] = {10 + i,
                              4,
                              "photo_0" + std::to_string(i) + ".png",
                              Eigen::Quaterniond::Identity(),
                              {1.0 * i, 0, 0},
                              {{10, 20, 7}, {30, 40, -1}}};
      model.points[7].track.emplace_back(10 + i, 0);
    }
    WriteColmapBinary(model, root_ / dir);
  }
};

TEST_F(ColmapCaptureTest, ModelAndPhotosAreReadWherePeoplePutThem) {
  for (const auto& [model, photos] :
       {std::pair{"sparse/0", "images/"}, {"sparse", "images/"}, {".", ""}, {"colmap/sparse/0", "input/"}}) {
    fs::remove_all(root_);
    WritePhotos(3, std::string(photos) + "photo_");
    WriteModel(model, 3);
    const Capture capture = RunIngest();
    EXPECT_EQ(capture.kind, "colmap") << model;
    EXPECT_EQ(model_.images.size(), 3u);
  }
}

TEST_F(ColmapCaptureTest, PointsAndTracksAreKeptForThePhotosUsedAndScaledWithThem) {
  WritePhotos(3, "images/photo_");
  WritePhoto(root_ / "images/photo_09.png", {.seed = 60});
  WriteModel("sparse/0", 4);
  const Capture capture = RunIngest();
  std::set<std::string> rejected;
  for (const RejectedFile& file : capture.rejected) rejected.insert(file.name);
  EXPECT_THAT(rejected, ElementsAre("images/photo_03.png", "images/photo_09.png"));
  ASSERT_EQ(model_.images.size(), 3u);
  EXPECT_EQ(model_.points.at(7).track.size(), 3u);
  EXPECT_EQ(model_.images.at(10).observations[0].x, 5);
  EXPECT_EQ(model_.images.at(10).observations[0].point_id, 7);
  EXPECT_THAT(model_.cameras.begin()->second.params, ElementsAre(60, 24, 16, 0.01));
  EXPECT_EQ(model_.images.at(12).name, "000002");
}

TEST_F(ColmapCaptureTest, TheLargestOfSeveralModelsIsTaken) {
  WritePhotos(5, "images/photo_");
  WriteModel("sparse/0", 3);
  WriteModel("sparse/1", 5);
  EXPECT_EQ(RunIngest().images.size(), 5u);
}

TEST_F(ColmapCaptureTest, PosesOfColmapAreForTheStoredRaster) {
  PhotoOptions turned;
  turned.metadata = [](OIIO::ImageSpec& spec) { spec.attribute("Orientation", 6); };
  for (uint32_t i = 0; i < 3; ++i) {
    turned.seed = i + 1;
    WritePhoto(root_ / ("images/photo_0" + std::to_string(i) + ".png"), turned, "jpeg");
  }
  WriteModel("sparse/0", 3);
  for (const CaptureImage& image : RunIngest().images) {
    EXPECT_EQ(image.info.orientation, 1);
    EXPECT_EQ(image.info.width, 48);
  }
}

TEST_F(ColmapCaptureTest, AModelWithoutItsPhotosIsAnErrorThatNamesOne) {
  WriteModel("sparse/0", 3);
  EXPECT_THAT(ErrorOf(), HasSubstr("photo_00.png"));
}

}  // namespace
}  // namespace nrff
