#include "sfm/ingest.h"

#include <gmock/gmock.h>
#include <sys/wait.h>

#include <cmath>
#include <cstdlib>
#include <fstream>
#include <map>
#include <numbers>
#include <set>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"
#include "sfm/capture.h"
#include "sfm/colmap_model.h"
#include "sfm/image_measures.h"
#include "sfm/transforms_json.h"
#include "tests/photo_fixtures.h"
#include "tests/temporary_directory.h"

namespace nrff {
namespace {

using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
namespace fs = std::filesystem;

class IngestTest : public ::testing::Test {
 protected:
  void Write(const fs::path& name, const std::string& bytes) {
    fs::create_directories((root_ / name).parent_path());
    std::ofstream(root_ / name, std::ios::binary | std::ios::trunc).write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
  }

  // n photos that differ, DIR/photo_00.png …
  void WritePhotos(int n, const std::string& stem = "photo_", PhotoOptions options = {}) {
    for (int i = 0; i < n; ++i) {
      options.seed = static_cast<uint32_t>(i + 1);
      WritePhoto(root_ / (stem + std::to_string(i / 10) + std::to_string(i % 10) + ".png"), options);
    }
  }

  Capture RunIngest() {
    const fs::path out = work_.path() / "ingest";
    ArtifactWriter artifact("ingest", out, {}, {CaptureInput(root_)});
    Ingest(root_, 2, artifact);
    artifact.Commit();
    manifest_ = RequireArtifact(out, "ingest");
    model_ = fs::exists(out / kGivenModelDir) ? ReadColmapModel(out / kGivenModelDir) : ColmapModel{};
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
      frames.push_back({{"file_path", stem + std::to_string(i / 10) + std::to_string(i % 10) + extension}, {"transform_matrix", RingPose(i, n)}});
    }
    return frames;
  }

  static std::map<std::string, Split> Splits(const Capture& capture) {
    std::map<std::string, Split> splits;
    for (const CaptureImage& image : capture.images) splits[image.Name()] = image.split;
    return splits;
  }

  TemporaryDirectory capture_dir_, work_;
  fs::path root_ = capture_dir_.path() / "cap";
  Manifest manifest_;
  ColmapModel model_;
};

TEST_F(IngestTest, APhotoFolderIsRecognisedInSubfoldersAndAnyCaseAndOtherFilesAreIgnored) {
  WritePhotos(3, "a/photo_");
  WritePhotos(2, "b/photo_", {.width = 32, .height = 48});
  fs::rename(root_ / "b/photo_00.png", root_ / "b/UPPER.PNG");
  Write("notes.txt", "not a photo");
  Write(".hidden.jpg", "not seen");
  const Capture capture = RunIngest();
  EXPECT_EQ(capture.kind, "photos");
  EXPECT_EQ(capture.name, "cap");
  EXPECT_FALSE(capture.posed);
  ASSERT_EQ(capture.images.size(), 5u);
  EXPECT_EQ(capture.images[3].path, "b/UPPER.PNG");
  EXPECT_EQ(capture.images[3].id, "000003");
  EXPECT_EQ(capture.images[3].camera, 1);
  EXPECT_TRUE(capture.rejected.empty());
  EXPECT_EQ(manifest_.facts["n_cameras"], 2);
  ASSERT_EQ(manifest_.decisions.size(), 1u);
  EXPECT_EQ(manifest_.decisions[0].feature, "sfm");
  EXPECT_TRUE(manifest_.decisions[0].needed);
}

TEST_F(IngestTest, CaptureFileReadsBackAsWritten) {
  WritePhotos(4);
  const Capture capture = RunIngest();
  TemporaryDirectory again;
  SaveCapture(capture, again.path());
  EXPECT_EQ(ReadFile(again.path() / kCaptureFile), ReadFile(work_.path() / "ingest" / kCaptureFile));
}

TEST_F(IngestTest, EveryEighthByNameIsHeldOutWhetherPosesAreGivenOrNot) {
  WritePhotos(17);
  const auto without_poses = Splits(RunIngest());
  EXPECT_EQ(std::count_if(without_poses.begin(), without_poses.end(), [](const auto& s) { return s.second == Split::kTest; }), 3);
  for (const char* name : {"photo_00.png", "photo_08.png", "photo_16.png"}) EXPECT_EQ(without_poses.at(name), Split::kTest);
  Json frames = RingFrames(17, "photo_");
  std::reverse(frames.begin(), frames.end());  // the file's order must not matter
  Write("transforms.json", Json{{"camera_angle_x", 0.8}, {"frames", frames}}.dump());
  const Capture posed = RunIngest();
  EXPECT_TRUE(posed.posed);
  EXPECT_EQ(Splits(posed), without_poses);
}

TEST_F(IngestTest, OriginalsAreUntouchedAndReadOnlyInputWorks) {
  WritePhotos(4);
  const std::string before = HashTree(root_);
  for (const auto& entry : fs::directory_iterator(root_)) fs::permissions(entry, fs::perms::owner_read);
  fs::permissions(root_, fs::perms::owner_read | fs::perms::owner_exec);
  RunIngest();
  fs::permissions(root_, fs::perms::owner_all);
  EXPECT_EQ(HashTree(root_), before);
}

TEST_F(IngestTest, UnusablePhotosAreRejectedByNameAndReason) {
  WritePhotos(4);
  const std::string whole = ReadFile(root_ / "photo_00.png");
  Write("cut.png", whole.substr(0, whole.size() / 2));
  Write("empty.jpg", "");
  Write("text.jpg", "just text");
  WritePhoto(root_ / "tiny.png", {.width = 1, .height = 1});
  Write("zcopy.png", whole);
  const Capture capture = RunIngest();
  EXPECT_EQ(capture.images.size(), 4u);
  std::map<std::string, std::string> reasons;
  for (const RejectedFile& file : capture.rejected) reasons[file.name] = file.reason;
  ASSERT_EQ(reasons.size(), 5u);
  EXPECT_THAT(reasons["cut.png"], HasSubstr("truncated"));
  EXPECT_THAT(reasons["empty.jpg"], HasSubstr("empty"));
  EXPECT_THAT(reasons["text.jpg"], HasSubstr("just text"));
  EXPECT_THAT(reasons["tiny.png"], HasSubstr("1×1"));
  EXPECT_EQ(reasons["zcopy.png"], "has the same bytes as photo_00.png");
  EXPECT_EQ(manifest_.facts["n_rejected"], 5);
}

TEST_F(IngestTest, AnAbsentOrEmptyFolderIsAnErrorThatNamesIt) {
  EXPECT_THAT(ErrorOf(), AllOf(HasSubstr("cap"), HasSubstr("does not exist")));
  fs::create_directories(root_);
  EXPECT_THAT(ErrorOf(), AllOf(HasSubstr("cap"), HasSubstr("0 files")));
  Write("readme.txt", "x");
  EXPECT_THAT(ErrorOf(), HasSubstr("none of them a photo"));
}

TEST_F(IngestTest, OnePhotoIsAnError) {
  WritePhotos(1);
  EXPECT_THAT(ErrorOf(), HasSubstr("one photo cannot be reconstructed"));
  root_ /= "photo_00.png";
  EXPECT_THAT(ErrorOf(), HasSubstr("is a file"));
}

TEST_F(IngestTest, IdenticalPhotosAreAnErrorThatSaysSo) {
  WritePhotos(1);
  for (const char* copy : {"x.png", "y.png", "z.png"}) fs::copy_file(root_ / "photo_00.png", root_ / copy);
  EXPECT_THAT(ErrorOf(), AllOf(HasSubstr("1 of 4"), HasSubstr("x.png has the same bytes as photo_00.png")));
}

TEST_F(IngestTest, OnlyDamagedPhotosIsAnErrorThatNamesOne) {
  for (const char* name : {"a.jpg", "b.jpg", "c.jpg"}) Write(name, "text");
  EXPECT_THAT(ErrorOf(), AllOf(HasSubstr("0 of 3"), HasSubstr("a.jpg is not a photo")));
}

TEST_F(IngestTest, NamesOfAnyBytesSurviveIntoCaptureJson) {
  const std::set<fs::path> names = {"a b.png", "new\nline.png", "quo\"te's.png", "raw-\xff\xfe.png", "per%20cent.png"};
  uint32_t seed = 0;
  for (const fs::path& name : names) WritePhoto(root_ / name, {.seed = ++seed});
  std::set<fs::path> read;
  for (const CaptureImage& image : RunIngest().images) read.insert(image.path);
  EXPECT_EQ(read, names);
}

TEST_F(IngestTest, SymbolicLinkLoopsEndAndLinkedPhotosAreRead) {
  WritePhotos(3);
  fs::create_directory_symlink(root_, root_ / "loop");
  fs::create_symlink("self.png", root_ / "self.png");
  WritePhoto(work_.path() / "outside.png", {.seed = 99});
  fs::create_symlink(work_.path() / "outside.png", root_ / "linked.png");
  EXPECT_EQ(RunIngest().images.size(), 4u);
}

TEST_F(IngestTest, AWorkspaceInsideTheCaptureIsPassedOver) {
  WritePhotos(3);
  WritePhotos(5, "work/cap/render/view_");
  Write("work/cap/nrff-workspace.json", "{}");
  EXPECT_EQ(RunIngest().images.size(), 3u);
}

TEST_F(IngestTest, MixedOrientationsAreRecordedAfterTurning) {
  WritePhotos(3);
  PhotoOptions turned{.seed = 50};
  turned.metadata = [](OIIO::ImageSpec& spec) { spec.attribute("Orientation", 6); };
  WritePhoto(root_ / "turned.jpg", turned, "jpeg");
  const Capture capture = RunIngest();
  const CaptureImage& image = capture.images.back();
  EXPECT_EQ(image.info.orientation, 6);
  EXPECT_EQ(image.info.width, 32);
  EXPECT_EQ(image.info.height, 48);
  EXPECT_EQ(capture.images.front().info.width, 48);
}

TEST_F(IngestTest, AlphaMeansAWhiteBackgroundUnlessItIsOpaque) {
  WritePhotos(3, "photo_", {.channels = 4, .alpha = 255});
  EXPECT_EQ(RunIngest().background, Background::kNone);
  EXPECT_FALSE(manifest_.facts["has_alpha"]);
  WritePhotos(3, "photo_", {.channels = 4, .alpha = 0});
  EXPECT_EQ(RunIngest().background, Background::kWhite);
  EXPECT_TRUE(manifest_.facts["has_alpha"]);
}

TEST_F(IngestTest, NerfSyntheticIsReadWithItsOwnSplitAndBox) {
  WritePhotos(5, "train/r_", {.channels = 4});
  WritePhotos(2, "test/r_", {.channels = 4, .alpha = 7});
  WritePhotos(2, "val/r_", {.channels = 4, .alpha = 9});
  for (const auto& [split, n] : std::map<std::string, int>{{"train", 5}, {"test", 2}, {"val", 2}}) {
    Write("transforms_" + split + ".json", Json{{"camera_angle_x", 0.6911112}, {"frames", RingFrames(n, "./" + split + "/r_", "")}}.dump());
  }
  const Capture capture = RunIngest();
  EXPECT_EQ(capture.kind, "transforms");
  EXPECT_EQ(capture.split_rule, "the data set's own");
  EXPECT_EQ(manifest_.facts["n_train"], 5);
  EXPECT_EQ(manifest_.facts["n_test"], 2);
  EXPECT_EQ(capture.background, Background::kWhite);
  ASSERT_TRUE(capture.box);
  EXPECT_EQ((*capture.box)[0], -1.5);
  ASSERT_EQ(model_.cameras.size(), 1u);
  const ColmapCamera& camera = model_.cameras.begin()->second;
  EXPECT_EQ(camera.model, CameraModel::kPinhole);
  EXPECT_NEAR(camera.params[0], 24 / std::tan(0.6911112 / 2), 1e-9);
  EXPECT_EQ(camera.params[2], 24);
  EXPECT_EQ(camera.params[3], 16);
  EXPECT_FALSE(manifest_.decisions[0].needed);
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
  Write("transforms.json", Json{{"fl_x", 50.5}, {"fl_y", 51.5}, {"cx", 24.5}, {"cy", 15.5}, {"w", 48.0}, {"h", 32.0}, {"k1", 0.1}, {"k2", -0.2},
                                {"p1", 1e-3}, {"p2", 2e-3}, {"aabb_scale", 4}, {"frames", frames}}.dump());
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

TEST_F(IngestTest, NerfstudioIntrinsicsPerFrameSplitsAndAppliedTransformAreUnderstood) {
  WritePhotos(4);
  Json frames = RingFrames(4, "photo_");
  for (Json& frame : frames) frame.update({{"fl_x", 60}, {"fl_y", 60}, {"cx", 24}, {"cy", 16}, {"w", 48}, {"h", 32}});
  frames[1].update({{"fl_x", 70}, {"camera_model", "OPENCV_FISHEYE"}, {"k1", 0.01}});
  const Json swap = {{0, 1, 0, 0}, {0, 0, 1, 0}, {1, 0, 0, 2}};
  Write("transforms.json", Json{{"frames", frames}, {"applied_transform", swap}, {"applied_scale", 2.0},
                                {"train_filenames", {"photo_00.png", "photo_01.png", "photo_02.png"}}, {"test_filenames", {"photo_03.png"}}}.dump());
  const Capture capture = RunIngest();
  EXPECT_EQ(capture.split_rule, "the data set's own");
  EXPECT_EQ(capture.images[3].split, Split::kTest);
  EXPECT_EQ(model_.cameras.size(), 2u);
  EXPECT_EQ(model_.cameras.at(model_.images.at(2).camera_id).model, CameraModel::kOpenCVFisheye);
  // In the file the first camera is at (0, 0.5, 3): at half scale (0, 0.25, 1.5), moved back (0, 0.25, −0.5), axes back.
  EXPECT_LT((model_.images.at(1).Center() - Eigen::Vector3d(-0.5, 0, 0.25)).norm(), 1e-12);
}

TEST_F(IngestTest, ResizedPhotosGetResizedCameras) {
  WritePhotos(3);
  Write("transforms.json", Json{{"fl_x", 100.0}, {"cx", 50.0}, {"cy", 30.0}, {"w", 96}, {"h", 64}, {"frames", RingFrames(3, "photo_")}}.dump());
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
    if (const size_t at = text.find("\"nan\""); at != std::string::npos) text.replace(at, 5, "NaN");  // as Python writes it
    Write("transforms.json", text);
    return ErrorOf();
  };
  const auto names_frame = AllOf(HasSubstr("transforms.json"), HasSubstr("photo_01.png"));
  EXPECT_THAT(error_with([](Json& m) { m[0][3] = "nan"; }), AllOf(names_frame, HasSubstr("NaN")));
  EXPECT_THAT(error_with([](Json& m) { for (int i = 0; i < 3; ++i) m[i][0] = -m[i][0].get<double>(); }), AllOf(names_frame, HasSubstr("left-handed")));
  EXPECT_THAT(error_with([](Json& m) { m[1][1] = 1.1; }), AllOf(names_frame, HasSubstr("not a rotation")));
  EXPECT_THAT(error_with([](Json& m) { m[1] = "x"; }), names_frame);
  EXPECT_THAT(error_with([](Json& m) { m.erase(1); m.erase(1); }), names_frame);
}

TEST_F(IngestTest, DamagedTransformsFilesAreErrorsThatNameTheFile) {
  WritePhotos(3);
  for (const char* text : {"", "{", "[]", "{\"frames\": []}", "{\"frames\": [{}]}", "{\"frames\": [{\"file_path\": 3}]}"}) {
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
    model.images[i] = {i, i == 2 ? 2u : 1u, "photo_0" + std::to_string(i - 1) + ".png",
                       Eigen::Quaterniond(1, 0.1 * i, -0.2, 0.3).normalized(), {1.0 * i, 2, -3}, {}};
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
  for (const char* text : {"60 24 16", "60. 24. 16. 0.\n", "60 24 16 0.\n0. 0. 0.\n0.\n1.\n32 48\n", "60 0 24 0 60 16 0 0 1"}) {
    Write("intrinsics.txt", text);
    RunIngest();
    EXPECT_THAT(model_.cameras.begin()->second.params, ElementsAre(60, 60, 24, 16)) << text;
  }
  Write("intrinsics.txt", "120 48 32 0.\n0. 0. 0.\n0.\n1.\n64 96\n");  // for photos of twice the size
  RunIngest();
  EXPECT_THAT(model_.cameras.begin()->second.params, ElementsAre(60, 60, 24, 16));
}

TEST_F(NsvfTest, BadFilesAreErrorsThatNameThem) {
  const std::map<std::string, std::string> spoiled = {{"pose/0_b.txt", "1 0 0 nan 0 1 0 0 0 0 1 0 0 0 0 1"},
                                                      {"intrinsics.txt", "1 2"},
                                                      {"bbox.txt", "1 1 1 0 0 0"}};
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
      model.images[10 + i] = {10 + i, 4, "photo_0" + std::to_string(i) + ".png", Eigen::Quaterniond::Identity(), {1.0 * i, 0, 0},
                              {{10, 20, 7}, {30, 40, -1}}};
      model.points[7].track.emplace_back(10 + i, 0);
    }
    WriteColmapBinary(model, root_ / dir);
  }
};

TEST_F(ColmapCaptureTest, ModelAndPhotosAreReadWherePeoplePutThem) {
  for (const auto& [model, photos] : {std::pair{"sparse/0", "images/"}, {"sparse", "images/"}, {".", ""}, {"colmap/sparse/0", "input/"}}) {
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

TEST(ImageMeasuresTest, BlurFallsWhenAPhotoIsSmoothed) {
  Image sharp{64, 64, 3, std::vector<uint8_t>(64 * 64 * 3)}, smooth = sharp;
  for (int y = 0; y < 64; ++y) {
    for (int x = 0; x < 64; ++x) {
      for (int c = 0; c < 3; ++c) {
        sharp.pixels[(y * 64 + x) * 3 + c] = (x / 4 + y / 4) % 2 ? 255 : 0;
        smooth.pixels[(y * 64 + x) * 3 + c] = static_cast<uint8_t>(127 + 127 * std::sin(x * 0.39) * std::sin(y * 0.39));
      }
    }
  }
  EXPECT_GT(MeasureBlur(sharp), 5 * MeasureBlur(smooth));
  EXPECT_EQ(MeasureBlur({20, 20, 3, std::vector<uint8_t>(1200, 80)}), 0);
}

TEST(ImageMeasuresTest, LookAlikesAreGroupedTransitively) {
  std::vector<DifferenceHash> hashes(6);
  hashes[2].set(0);
  hashes[2].set(1);               // 2 bits from hash 0
  hashes[4] = hashes[2];
  hashes[4].set(2).set(3);        // 4 bits from hash 0, 2 from hash 2
  hashes[1].set();
  hashes[3].set().flip(9);
  for (int i = 0; i < 128; ++i) hashes[5].set(2 * i);
  EXPECT_THAT(GroupAlike(hashes), ElementsAre(ElementsAre(0, 2, 4), ElementsAre(1, 3)));
}

TEST(ImageMeasuresTest, OrderIsToldFromTimeStampsElseFromNumbers) {
  const std::vector<std::optional<std::string>> none(3), forward = {"2020:01:01 00:00:01", "2020:01:01 00:00:01", "2020:01:01 00:00:07"},
                                                back = {"2020:01:01 00:00:02", "2020:01:01 00:00:01", "2020:01:01 00:00:03"},
                                                partial = {"2020:01:01 00:00:02", "2020:01:01 00:00:01", {}};
  const std::vector<fs::path> numbered = {"IMG_0001.JPG", "IMG_0002.JPG", "IMG_0005.JPG"}, unpadded = {"1.jpg", "10.jpg", "2.jpg"},
                              far = {"a10.jpg", "a20.jpg", "a90.jpg"}, named = {"cat.jpg", "dog.jpg", "eel.jpg"}, mixed = {"a1.jpg", "b2.jpg", "c3.jpg"};
  EXPECT_TRUE(IsOrdered(numbered, none));
  EXPECT_FALSE(IsOrdered(unpadded, none));
  EXPECT_FALSE(IsOrdered(far, none));
  EXPECT_FALSE(IsOrdered(named, none));
  EXPECT_FALSE(IsOrdered(mixed, none));
  EXPECT_TRUE(IsOrdered(named, forward));
  EXPECT_FALSE(IsOrdered(numbered, back));
  EXPECT_TRUE(IsOrdered(numbered, partial));
}

// The executable: exit code and output.
std::pair<int, std::string> RunCommand(const std::string& arguments) {
  const std::string command = std::string(NRFF_BIN_DIR) + "/nrff-ingest " + arguments + " 2>&1";
  std::string output;
  FILE* pipe = popen(command.c_str(), "r");
  for (int c; (c = fgetc(pipe)) != EOF;) output += static_cast<char>(c);
  return {WEXITSTATUS(pclose(pipe)), output};
}

TEST_F(IngestTest, ExecutableEndsWithTheDocumentedExitCodes) {
  EXPECT_EQ(RunCommand("").first, 2);
  EXPECT_EQ(RunCommand(root_.string()).first, 2);
  EXPECT_EQ(RunCommand(root_.string() + " --probe").first, 3);
  WritePhotos(3);
  EXPECT_EQ(RunCommand(root_.string() + " --quiet --out " + (work_.path() / "out").string()).first, 0);
  EXPECT_EQ(RequireArtifact(work_.path() / "out", "ingest").facts["n_images"], 3);
  const auto [code, output] = RunCommand(root_.string() + " --probe");
  EXPECT_EQ(code, 0);
  EXPECT_EQ(Json::parse(output), (Json{{"kind", "photos"}, {"name", "cap"}, {"n_images", 3}, {"posed", false},
                                       {"split_rule", "every 8th by file name"}, {"has_alpha", false}, {"n_train", 2}, {"n_test", 1}}));
}

class RealCaptureTest : public IngestTest {
 protected:
  void SetUp() override {
    const char* given = std::getenv("NRFF_DATA");
    data_ = given ? fs::path(given) : fs::path(NRFF_SOURCE_DIR) / "../shared/data";
    if (!fs::exists(data_)) GTEST_SKIP() << "no " << data_ << "; set NRFF_DATA";
  }
  fs::path data_;
};

TEST_F(RealCaptureTest, EveryCaptureIsRecognisedWithItsCounts) {
  struct {
    const char* path;
    const char* kind;
    int n_train, n_test;
  } const kCaptures[] = {{"photos/sceaux_castle", "photos", 9, 2}, {"photos/kermit", "photos", 9, 2},
                         {"photos/ET", "photos", 7, 2}, {"photos/maryrose", "photos", 60, 9},
                         {"scenes/fox", "transforms", 43, 7}, {"scenes/fox/images", "photos", 43, 7},
                         {"scenes/maryrose_tnt", "nsvf", 60, 9}, {"scenes/lego_nsvf_400", "transforms", 100, 50},
                         {"colmap_models/cup_simple_pinhole", "colmap", 67, 10}};
  for (const auto& expected : kCaptures) {
    const Json probe = ProbeCapture(data_ / expected.path);
    EXPECT_EQ(probe["kind"], expected.kind) << expected.path;
    EXPECT_EQ(probe["n_train"], expected.n_train) << expected.path;
    EXPECT_EQ(probe["n_test"], expected.n_test) << expected.path;
  }
}

TEST_F(RealCaptureTest, FoxListsTheFramesThatDoNotExist) {
  root_ = data_ / "scenes/fox";
  const Capture capture = RunIngest();
  EXPECT_EQ(capture.images.size(), 50u);
  EXPECT_EQ(capture.rejected.size(), 17u);
  EXPECT_TRUE(capture.ordered);
}

TEST_F(RealCaptureTest, LegoHasTheSamePosesInBothItsLayouts) {
  root_ = data_ / "scenes/lego_nsvf_400";
  const Capture capture = RunIngest();
  const ColmapModel transforms = model_;
  root_ = capture_dir_.path() / "nsvf";
  fs::create_directories(root_);
  fs::create_directory_symlink(data_ / "scenes/lego_nsvf_400/rgb", root_ / "rgb");
  fs::create_directory_symlink(data_ / "scenes/lego_nsvf_400/gt/pose", root_ / "pose");
  for (const char* name : {"intrinsics.txt", "bbox.txt"}) fs::create_symlink(data_ / "scenes/lego_nsvf_400/gt" / name, root_ / name);
  const Capture nsvf = RunIngest();
  EXPECT_EQ(Splits(nsvf), Splits(capture));
  std::map<std::string, const ColmapImage*> by_name;
  for (const auto& [id, image] : model_.images) by_name[image.name] = &image;
  ASSERT_EQ(by_name.size(), transforms.images.size());
  for (const auto& [id, image] : transforms.images) {
    EXPECT_LT((by_name.at(image.name)->Center() - image.Center()).norm(), 1e-5);
    EXPECT_LT(by_name.at(image.name)->rotation.angularDistance(image.rotation), 1e-5);
  }
  for (int i = 0; i < 4; ++i) EXPECT_NEAR(transforms.cameras.begin()->second.params[i], model_.cameras.begin()->second.params[i], 1e-3);
}

}  // namespace
}  // namespace nrff
