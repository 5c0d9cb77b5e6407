#include "sfm/ingest.h"

#include <gmock/gmock.h>
#include <sys/wait.h>

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <set>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "sfm/image_measures.h"
#include "tests/ingest_fixture.h"

namespace nrff {
namespace {

using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
namespace fs = std::filesystem;

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
  EXPECT_EQ(
      std::count_if(without_poses.begin(), without_poses.end(), [](const auto& s) { return s.second == Split::kTest; }),
      3);
  for (const char* name : {"photo_00.png", "photo_08.png", "photo_16.png"})
    EXPECT_EQ(without_poses.at(name), Split::kTest);
  Json frames = RingFrames(17, "photo_");
  std::reverse(frames.begin(), frames.end());  // the file's order must not matter
  Write("transforms.json", Json{{"camera_angle_x", 0.8}, {"frames", frames}}.dump());
  const Capture posed = RunIngest();
  EXPECT_TRUE(posed.posed);
  EXPECT_EQ(Splits(posed), without_poses);
}

class ExtendedIngest : public IngestTest {
 protected:
  // What ingest made of the capture so far becomes the base.
  void KeepBase() {
    options_.base = work_.path() / ("base " + std::to_string(++n_bases_));
    fs::rename(work_.path() / "ingest", options_.base);
  }
  static std::vector<std::string> Names(const Capture& capture) {
    std::vector<std::string> names;
    for (const CaptureImage& image : capture.images) names.push_back(image.id + " " + image.Name());
    return names;
  }
  IngestOptions options_;
  int n_bases_ = 0;
};

TEST_F(ExtendedIngest, EarlierPhotosKeepTheirIdsAndSidesAndAddedOnesCountOn) {
  WritePhotos(15, "m_");
  const Capture before = RunIngest();
  KeepBase();
  for (int i = 0; i < 4; ++i) {
    PhotoOptions photo;
    photo.seed = uint32_t(100 + i);
    WritePhoto(root_ / ((i < 3 ? "a_" : "z_") + std::to_string(i) + ".png"), photo);  // before and behind the others
  }
  EXPECT_EQ(ProbeCapture(root_, options_.base)["extension"], Json({{"n_earlier", 15}, {"n_added", 4}}));
  const Capture after = RunIngest(options_);
  ASSERT_EQ(after.images.size(), 19u);
  std::vector<std::string> expected = Names(before);
  expected.insert(expected.end(), {"000015 a_0.png", "000016 a_1.png", "000017 a_2.png", "000018 z_3.png"});
  EXPECT_EQ(Names(after), expected);
  std::map<std::string, Split> sides = Splits(before);
  for (const char* name : {"a_0.png", "a_2.png", "z_3.png"}) sides[name] = Split::kTrain;
  sides["a_1.png"] = Split::kTest;  // the 17th
  EXPECT_EQ(Splits(after), sides);
  EXPECT_EQ(after.split_rule, "every 8th by file name; added photos count on");
  EXPECT_EQ(manifest_.facts["extension"], Json({{"n_earlier", 15}, {"n_added", 4}}));
  EXPECT_TRUE(manifest_.facts["why_anew"].is_null());
  // And once more: single photos added do not all become held out.
  KeepBase();
  PhotoOptions photo;
  photo.seed = 200;
  WritePhoto(root_ / "b.png", photo);
  const Capture again = RunIngest(options_);
  EXPECT_EQ(again.images.back().id + again.images.back().Name(), "000019b.png");
  EXPECT_EQ(again.images.back().split, Split::kTrain);
  EXPECT_EQ(again.split_rule, after.split_rule);
}

TEST_F(ExtendedIngest, IsNoneWhereAPhotoIsGoneOrChanged) {
  WritePhotos(9);
  RunIngest();
  KeepBase();
  WritePhoto(root_ / "added.png", {.seed = 100});
  WritePhoto(root_ / "photo_03.png", {.seed = 101});
  for (const char* reason : {"photo_03.png was changed", "photo_03.png is no longer among"}) {
    EXPECT_THAT(ProbeCapture(root_, options_.base)["why_anew"].get<std::string>(), HasSubstr(reason));
    const Capture anew = RunIngest(options_);
    EXPECT_THAT(manifest_.facts["why_anew"].get<std::string>(), HasSubstr(reason));
    EXPECT_TRUE(manifest_.facts["extension"].is_null());
    EXPECT_EQ(anew.images[0].Name(), "added.png");
    EXPECT_EQ(anew.split_rule, "every 8th by file name");
    fs::remove(root_ / "photo_03.png");
  }
}

TEST_F(ExtendedIngest, ACopyOfAnEarlierPhotoIsTheOneThatIsRejected) {
  WritePhotos(9);
  RunIngest();
  KeepBase();
  fs::copy_file(root_ / "photo_03.png", root_ / "a copy.png");
  const Capture after = RunIngest(options_);
  EXPECT_EQ(after.images.size(), 9u);
  ASSERT_EQ(after.rejected.size(), 1u);
  EXPECT_EQ(after.rejected[0].name, "a copy.png");
}

TEST_F(ExtendedIngest, PhotosThatWereOfNoUseBeforeAreNoneAdded) {
  WritePhotos(9);
  Write("damaged.jpg", "just text");
  RunIngest();
  KeepBase();
  Write("notes.txt", "x");
  EXPECT_EQ(ProbeCapture(root_, options_.base)["why_anew"], "no photo was added");
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

TEST_F(IngestTest, RawFilesArePassedOverByNameUnlessTheirPhotoIsThere) {
  WritePhotos(3);
  Write("photo_00.NEF", "the original of photo_00.png");
  Write("other.cr2", "raw");
  const Capture capture = RunIngest();
  ASSERT_EQ(capture.rejected.size(), 1u);
  EXPECT_EQ(capture.rejected[0].name, "other.cr2");
  EXPECT_THAT(capture.rejected[0].reason, HasSubstr("is a camera raw file"));
}

TEST_F(IngestTest, AnAbsentOrEmptyFolderIsAnErrorThatNamesIt) {
  EXPECT_THAT(ErrorOf(), AllOf(HasSubstr("cap"), HasSubstr("does not exist")));
  fs::create_directories(root_);
  EXPECT_THAT(ErrorOf(), AllOf(HasSubstr("cap"), HasSubstr("files: 0")));
  Write("readme.txt", "x");
  EXPECT_THAT(ErrorOf(), HasSubstr("files: 1, photos: none"));
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
  EXPECT_EQ(image.camera, capture.images.front().camera) << "one camera, turned";
  EXPECT_EQ(manifest_.facts["n_cameras"], 1);
}

TEST_F(IngestTest, AlphaMeansAWhiteBackgroundUnlessItIsOpaque) {
  WritePhotos(3, "photo_", {.channels = 4, .alpha = 255});
  EXPECT_EQ(RunIngest().background, Background::kNone);
  EXPECT_FALSE(manifest_.facts["has_alpha"]);
  WritePhotos(3, "photo_", {.channels = 4, .alpha = 0});
  EXPECT_EQ(RunIngest().background, Background::kWhite);
  EXPECT_TRUE(manifest_.facts["has_alpha"]);
}

TEST_F(IngestTest, APlainBackdropOfTheTrainingPhotosIsTheBackground) {
  WritePhotos(5, "photo_", {.backdrop = 250});
  EXPECT_EQ(RunIngest().background, Background::kWhite);
  EXPECT_EQ(manifest_.facts["background"], "white");
  WritePhoto(root_ / "photo_00.png", {.seed = 77});  // held out: its frame decides nothing
  EXPECT_EQ(RunIngest().background, Background::kWhite);
  WritePhotos(4, "photo_", {.backdrop = 128});
  EXPECT_EQ(RunIngest().background, Background::kNone);
  EXPECT_EQ(manifest_.facts["background"], "none");
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

// A disc of noise on a plain colour.
Image BeforeBackdrop(uint8_t backdrop) {
  Image image{100, 80, 3, std::vector<uint8_t>(100 * 80 * 3, backdrop)};
  for (int y = 0; y < 80; ++y) {
    for (int x = 0; x < 100; ++x) {
      if (std::hypot(x - 50, y - 40) > 30) continue;
      for (int c = 0; c < 3; ++c) image.pixels[(y * 100 + x) * 3 + c] = uint8_t((x * 37 + y * 91 + c * 53) % 256);
    }
  }
  return image;
}

TEST(ImageMeasuresTest, APlainBackdropIsToldFromTheFrame) {
  const Image white = BeforeBackdrop(245), black = BeforeBackdrop(5), grey = BeforeBackdrop(128);
  EXPECT_EQ(MeasureFrame(white).white, 1);
  EXPECT_EQ(MeasureFrame(white).black, 0);
  Image half = white;  // the lower half is another colour: 2 px of 80 at the bottom and half of the sides
  std::fill(half.pixels.begin() + std::ptrdiff_t(half.pixels.size() / 2), half.pixels.end(), uint8_t(100));
  EXPECT_NEAR(MeasureFrame(half).white, 0.5, 1e-9);
  const auto background = [](const std::vector<Image>& images) {
    std::vector<FrameShares> frames;
    frames.reserve(images.size());
    for (const Image& image : images) frames.push_back(MeasureFrame(image));
    return PlainBackground(frames);
  };
  EXPECT_EQ(background({white, white, half}), Background::kWhite);
  EXPECT_EQ(background({white, half, half}), Background::kNone);
  EXPECT_EQ(background({black, black, grey}), Background::kBlack);
  EXPECT_EQ(background({grey}), Background::kNone);
  EXPECT_EQ(background({}), Background::kNone);
}

TEST(ImageMeasuresTest, LookAlikesAreGroupedTransitively) {
  std::vector<DifferenceHash> hashes(6);
  hashes[2].set(0);
  hashes[2].set(1);  // 2 bits from hash 0
  hashes[4] = hashes[2];
  hashes[4].set(2).set(3);  // 4 bits from hash 0, 2 from hash 2
  hashes[1].set();
  hashes[3].set().flip(9);
  for (int i = 0; i < 128; ++i) hashes[5].set(2 * i);
  EXPECT_THAT(GroupAlike(hashes), ElementsAre(ElementsAre(0, 2, 4), ElementsAre(1, 3)));
}

TEST(ImageMeasuresTest, OrderIsToldFromTimeStampsElseFromNumbers) {
  const std::vector<std::optional<std::string>> none(3),
      forward = {"2020:01:01 00:00:01", "2020:01:01 00:00:01", "2020:01:01 00:00:07"},
      back = {"2020:01:01 00:00:02", "2020:01:01 00:00:01", "2020:01:01 00:00:03"},
      partial = {"2020:01:01 00:00:02", "2020:01:01 00:00:01", {}};
  const std::vector<fs::path> numbered = {"IMG_0001.JPG", "IMG_0002.JPG", "IMG_0005.JPG"},
                              unpadded = {"1.jpg", "10.jpg", "2.jpg"}, far = {"a10.jpg", "a20.jpg", "a90.jpg"},
                              named = {"cat.jpg", "dog.jpg", "eel.jpg"}, mixed = {"a1.jpg", "b2.jpg", "c3.jpg"};
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
  EXPECT_EQ(Json::parse(output), (Json{{"kind", "photos"},
                                       {"name", "cap"},
                                       {"n_images", 3},
                                       {"posed", false},
                                       {"split_rule", "every 8th by file name"},
                                       {"has_alpha", false},
                                       {"n_masks", 0},
                                       {"n_videos", 0},
                                       {"n_train", 2},
                                       {"n_test", 1}}));
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
  } const kCaptures[] = {{"photos/sceaux_castle", "photos", 9, 2},
                         {"photos/kermit", "photos", 9, 2},
                         {"photos/ET", "photos", 7, 2},
                         {"photos/maryrose", "photos", 60, 9},
                         {"scenes/fox", "transforms", 43, 7},
                         {"scenes/fox/images", "photos", 43, 7},
                         {"scenes/maryrose_tnt", "nsvf", 60, 9},
                         {"scenes/lego_nsvf_400", "transforms", 100, 50},
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
  for (const char* name : {"intrinsics.txt", "bbox.txt"})
    fs::create_symlink(data_ / "scenes/lego_nsvf_400/gt" / name, root_ / name);
  const Capture nsvf = RunIngest();
  EXPECT_EQ(Splits(nsvf), Splits(capture));
  std::map<std::string, const ColmapImage*> by_name;
  for (const auto& [id, image] : model_.images) by_name[image.name] = &image;
  ASSERT_EQ(by_name.size(), transforms.images.size());
  for (const auto& [id, image] : transforms.images) {
    EXPECT_LT((by_name.at(image.name)->Center() - image.Center()).norm(), 1e-5);
    EXPECT_LT(by_name.at(image.name)->rotation.angularDistance(image.rotation), 1e-5);
  }
  for (int i = 0; i < 4; ++i)
    EXPECT_NEAR(transforms.cameras.begin()->second.params[i], model_.cameras.begin()->second.params[i], 1e-3);
}

}  // namespace
}  // namespace nrff
