// Captures that cannot be used: each ends with one clear sentence and the right exit code, and what was complete before
// stays as it was.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <fstream>
#include <functional>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/manifest.h"
#include "tests/program.h"
#include "tests/temporary_directory.h"
#include "tests/test_photos.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::SizeIs;
using testing::UnorderedElementsAre;

void WriteText(const fs::path& path, const std::string& text) { std::ofstream(path, std::ios::binary) << text; }

// One sentence that holds all of `fragments`, and this exit code.
void ExpectError(const ProgramResult& result, ExitCode code, const std::vector<std::string>& fragments) {
  EXPECT_EQ(result.exit_code, static_cast<int>(code)) << result.err;
  ASSERT_THAT(result.Errors(), SizeIs(1)) << result.err;
  for (const std::string& fragment : fragments) EXPECT_THAT(result.Errors()[0], HasSubstr(fragment));
}

std::vector<std::string> RejectedNames(const Manifest& ingest) {
  std::vector<std::string> names;
  for (const Json& file : ingest.facts.at("rejected")) names.push_back(file.at("name"));
  return names;
}

// A posed capture of four photos in `dir`; `matrix(i)` is the transform_matrix of the i-th as JSON text.
void WritePosedCapture(const fs::path& dir, const std::function<std::string(int)>& matrix, bool with_photos = true) {
  fs::create_directories(dir);
  if (with_photos) WriteUnrelatedPhotos(dir, 4);
  std::string frames;
  for (int i = 0; i < 4; ++i) {
    frames += std::string(i == 0 ? "" : ",") + R"({"file_path": "p0)" + std::to_string(i) +
              R"(.jpg", "transform_matrix": )" + matrix(i) + "}";
  }
  WriteText(dir / "transforms.json", R"({"fl_x": 100, "w": 96, "h": 64, "frames": [)" + frames + "]}");
}

std::string GoodMatrix(int i) { return "[[1,0,0," + std::to_string(i) + "],[0,1,0,0],[0,0,1,3],[0,0,0,1]]"; }

// --- What ingest refuses
// ----------------------------------------------------------------------------------------------

struct RefusedCapture {
  const char* name;
  std::function<void(const fs::path& dir)> make;
  std::vector<std::string> fragments;  // of the error
};

class Refused : public testing::TestWithParam<RefusedCapture> {
 protected:
  static void SetUpTestSuite() {
    earlier_ = new TemporaryDirectory;
    WriteUnrelatedPhotos(earlier_->path() / "photos", 4);
    ASSERT_EQ(RunProgram({"nrff-ingest", earlier_->path() / "photos", "--out", earlier_->path() / "ingest"}).exit_code,
              0);
  }
  static void TearDownTestSuite() { delete earlier_; }

  inline static TemporaryDirectory* earlier_ = nullptr;
};

TEST_P(Refused, EndsWithOneSentenceAndLeavesTheEarlierArtifact) {
  const TemporaryDirectory temporary;
  const fs::path bad = temporary.path() / "bad", out = temporary.path() / "ingest";
  fs::copy(earlier_->path() / "ingest", out, fs::copy_options::recursive);
  const std::string before = HashTree(out);

  fs::create_directories(bad);
  GetParam().make(bad);
  const std::string originals = HashTree(bad);
  ExpectError(RunProgram({"nrff-ingest", bad, "--out", out}), ExitCode::kInput, GetParam().fragments);
  EXPECT_EQ(HashTree(out), before);
  EXPECT_EQ(HashTree(bad), originals);
}

INSTANTIATE_TEST_SUITE_P(
    Captures, Refused,
    testing::Values(
        RefusedCapture{"EmptyFolder", [](const fs::path&) {}, {"bad", "no capture"}},
        RefusedCapture{"NoPhotoAmongTheFiles",
                       [](const fs::path& dir) { WriteText(dir / "notes.txt", "none"); },
                       {"bad", "files: 1, photos: none"}},
        RefusedCapture{"OnlyRawFiles",
                       [](const fs::path& dir) { WriteText(dir / "DSC_1.NEF", "raw"); },
                       {"bad", "photos: none", "DSC_1.NEF is a camera raw file: export it"}},
        RefusedCapture{"OnePhoto", [](const fs::path& dir) { WriteUnrelatedPhotos(dir, 1); }, {"bad", "one photo"}},
        RefusedCapture{"IdenticalPhotos",
                       [](const fs::path& dir) {
                         WriteUnrelatedPhotos(dir, 1);
                         for (const char* copy : {"q.jpg", "r.jpg", "s.jpg"})
                           fs::copy_file(dir / "p00.jpg", dir / copy);
                       },
                       {"bad", "1 of 4", "same bytes"}},
        RefusedCapture{"OnlyZeroByteFiles",
                       [](const fs::path& dir) {
                         for (const char* name : {"a.jpg", "b.jpg", "c.jpg"}) WriteText(dir / name, "");
                       },
                       {"bad", "0 of 3", "a.jpg"}},
        RefusedCapture{"OnlyTextCalledJpeg",
                       [](const fs::path& dir) {
                         for (const char* name : {"a.jpg", "b.jpg", "c.jpg"}) WriteText(dir / name, "not a photo");
                       },
                       {"bad", "0 of 3", "a.jpg"}},
        RefusedCapture{"OnlyOnePixelPhotos",
                       [](const fs::path& dir) { WriteUnrelatedPhotos(dir, 4, 1, 1); },
                       {"bad", "0 of 4", "1×1"}},
        RefusedCapture{"LinksThatLeadToThemselves",
                       [](const fs::path& dir) {
                         fs::create_symlink("loop.jpg", dir / "loop.jpg");
                         fs::create_directory_symlink(".", dir / "again");
                       },
                       {"bad", "no capture"}},
        RefusedCapture{"PoseWithNaN",
                       [](const fs::path& dir) {
                         WritePosedCapture(dir, [](int i) {
                           return i == 2 ? "[[1,0,0,NaN],[0,1,0,0],[0,0,1,3],[0,0,0,1]]" : GoodMatrix(i);
                         });
                       },
                       {"transforms.json", "p02.jpg", "NaN"}},
        RefusedCapture{"LeftHandedPose",
                       [](const fs::path& dir) {
                         WritePosedCapture(dir, [](int i) {
                           return i == 1 ? "[[-1,0,0,0],[0,1,0,0],[0,0,1,3],[0,0,0,1]]" : GoodMatrix(i);
                         });
                       },
                       {"transforms.json", "p01.jpg", "left-handed"}},
        RefusedCapture{"PoseThatIsNoRotation",
                       [](const fs::path& dir) {
                         WritePosedCapture(dir, [](int) { return "[[2,0,0,0],[0,1,0,0],[0,0,1,3],[0,0,0,1]]"; });
                       },
                       {"transforms.json", "p00.jpg", "rotation"}},
        RefusedCapture{"TransformsNamingNothingThatExists",
                       [](const fs::path& dir) { WritePosedCapture(dir, GoodMatrix, /*with_photos=*/false); },
                       {"bad", "p00.jpg", "does not exist"}},
        RefusedCapture{"TransformsCutShort",
                       [](const fs::path& dir) {
                         WritePosedCapture(dir, GoodMatrix);
                         fs::resize_file(dir / "transforms.json", fs::file_size(dir / "transforms.json") / 2);
                       },
                       {"transforms.json", "JSON"}},
        RefusedCapture{"ColmapModelWithNaN",
                       [](const fs::path& dir) {
                         fs::create_directories(dir / "sparse/0");
                         WriteUnrelatedPhotos(dir / "images", 4);
                         WriteText(dir / "sparse/0/cameras.txt", "1 PINHOLE 96 64 100 100 48 32\n");
                         WriteText(dir / "sparse/0/images.txt",
                                   "1 1 0 0 0 0 0 3 1 p00.jpg\n\n2 1 0 0 0 nan 0 3 1 p01.jpg\n\n");
                         WriteText(dir / "sparse/0/points3D.txt", "");
                       },
                       {"images.txt", "p01.jpg"}}),
    [](const auto& info) { return info.param.name; });

TEST(BadInput, CaptureThatIsNotThereIsNamed) {
  const TemporaryDirectory temporary;
  const fs::path out = temporary.path() / "ingest", work = temporary.path() / "work";
  ExpectError(RunProgram({"nrff-ingest", temporary.path() / "nowhere", "--out", out}), ExitCode::kInput, {"nowhere"});
  ExpectError(RunProgram({"nrff", "run", temporary.path() / "nowhere", "-w", work}), ExitCode::kInput, {"nowhere"});
  EXPECT_FALSE(fs::exists(out));
}

TEST(BadInput, UnknownOptionIsAUsageError) {
  ExpectError(RunProgram({"nrff-ingest", "--no-such-option"}), ExitCode::kUsage, {"nrff-ingest"});
  ExpectError(RunProgram({"nrff", "run", "photos", "--until", "tomorrow"}), ExitCode::kUsage, {"tomorrow"});
}

TEST(BadInput, WhatOnlyTrainingWouldRefuseIsRefusedBeforeAnythingRuns) {
  const TemporaryDirectory temporary;
  WriteUnrelatedPhotos(temporary.path() / "photos", 4);
  const fs::path work = temporary.path() / "work";
  const auto expect = [&](const std::vector<std::string>& options, ExitCode code, const std::string& fragment) {
    for (const char* command : {"run", "plan"}) {
      std::vector<std::string> line = {"nrff", command, temporary.path() / "photos", "--workspace", work};
      line.insert(line.end(), options.begin(), options.end());
      ExpectError(RunProgram(line), code, {fragment});
      EXPECT_FALSE(fs::exists(work)) << command;
    }
  };
  expect({"--preset", "huge"}, ExitCode::kUsage, "the presets are paper, small, tiny");
  expect({"--set", "field.colour=3"}, ExitCode::kUsage, "there is no field.colour; there are");
  expect({"--device", "cuda"}, ExitCode::kResource, "use --device auto or cpu");
  expect({"--max-image-size", "7"}, ExitCode::kUsage, "from 16 to 65536");
  expect({"--max-image-size", "70000"}, ExitCode::kUsage, "from 16 to 65536");
  expect({"--threads", "2000"}, ExitCode::kUsage, "from 1 to 1024");
}

TEST(BadInput, RunSaysWhatIngestSays) {
  const TemporaryDirectory temporary;
  fs::create_directories(temporary.path() / "empty");
  ExpectError(RunProgram({"nrff", "run", temporary.path() / "empty", "-w", temporary.path() / "work"}),
              ExitCode::kInput, {"empty", "no capture"});
}

// --- What ingest leaves out
// -------------------------------------------------------------------------------------------

TEST(BadInput, DamagedFilesAreLeftOutByNameAndReason) {
  const TemporaryDirectory temporary;
  const fs::path dir = temporary.path() / "photos", out = temporary.path() / "ingest";
  WriteUnrelatedPhotos(dir, 6, 160, 120);
  WriteText(dir / "zero.jpg", "");
  WriteText(dir / "text.jpg", "This is a text file.");
  WriteTestPhoto(dir / "tiny.png", {.width = 1, .height = 1});
  fs::copy_file(dir / "p00.jpg", dir / "cut.jpg");
  fs::resize_file(dir / "cut.jpg", fs::file_size(dir / "cut.jpg") / 3);
  WriteTestPhoto(dir / "cut.png", {.width = 160, .height = 120, .seed = 99});
  fs::resize_file(dir / "cut.png", fs::file_size(dir / "cut.png") / 3);
  fs::copy_file(dir / "p01.jpg", dir / "twice.jpg");
  fs::create_symlink("nowhere.jpg", dir / "dangling.jpg");

  const ProgramResult result = RunProgram({"nrff-ingest", dir, "--out", out});
  ASSERT_EQ(result.exit_code, 0) << result.err;
  const Manifest manifest = RequireArtifact(out, "ingest");
  EXPECT_EQ(manifest.facts.at("n_images"), 6);
  EXPECT_THAT(RejectedNames(manifest),
              UnorderedElementsAre("zero.jpg", "text.jpg", "tiny.png", "cut.jpg", "cut.png", "twice.jpg"));
  for (const Json& file : manifest.facts.at("rejected")) EXPECT_GT(file.at("reason").get<std::string>().size(), 8u);
}

TEST(BadInput, FramesWithoutPhotosAreLeftOutAndTheRestIsUsed) {
  const TemporaryDirectory temporary;
  const fs::path dir = temporary.path() / "posed", out = temporary.path() / "ingest";
  WritePosedCapture(dir, GoodMatrix);
  fs::remove(dir / "p03.jpg");
  const ProgramResult result = RunProgram({"nrff-ingest", dir, "--out", out});
  ASSERT_EQ(result.exit_code, 0) << result.err;
  const Manifest manifest = RequireArtifact(out, "ingest");
  EXPECT_EQ(manifest.facts.at("n_images"), 3);
  EXPECT_THAT(RejectedNames(manifest), ElementsAre("p03.jpg"));
}

TEST(BadInput, MixedSizesAndOrientationsAreToldApart) {
  const TemporaryDirectory temporary;
  const fs::path dir = temporary.path() / "photos", out = temporary.path() / "ingest";
  WriteUnrelatedPhotos(dir, 4, 96, 64);
  WriteTestPhoto(dir / "turned.jpg", {.width = 96, .height = 64, .seed = 50, .orientation = 6});
  WriteTestPhoto(dir / "upright.jpg", {.width = 64, .height = 96, .seed = 51});
  WriteTestPhoto(dir / "wide.png", {.width = 200, .height = 50, .seed = 52});
  ASSERT_EQ(RunProgram({"nrff-ingest", dir, "--out", out}).exit_code, 0);
  EXPECT_EQ(RequireArtifact(out, "ingest").facts.at("n_cameras"), 3);
  const Json capture = ReadJson(out / "capture.json");
  for (const Json& image : capture.at("images")) {
    if (image.at("name") != "turned.jpg") continue;
    EXPECT_EQ(image.at("width"), 64);
    EXPECT_EQ(image.at("height"), 96);
  }
}

TEST(BadInput, AnyFileNameIsFineAndLinkLoopsEnd) {
  const TemporaryDirectory temporary;
  const fs::path dir = temporary.path() / "a \"strange\" dir\n", out = temporary.path() / "ingest";
  WriteUnrelatedPhotos(dir, 1);
  const std::vector<std::string> names = {"with space.jpg", "new\nline.jpg", "quo\"te's.jpg", "bytes\xff\xfe.jpg",
                                          "-option.jpg",    "100%.jpg",      "ünïcode.jpg"};
  uint32_t seed = 100;
  for (const std::string& name : names) {
    // Image libraries take names as UTF-8, so the odd name is given afterwards.
    WriteTestPhoto(dir / "plain.jpg", {.seed = ++seed});
    fs::rename(dir / "plain.jpg", dir / name);
  }
  fs::create_directory_symlink("..", dir / "up");
  fs::create_symlink("self.jpg", dir / "self.jpg");
  const ProgramResult result = RunProgram({"nrff-ingest", dir, "--out", out});
  ASSERT_EQ(result.exit_code, 0) << result.err;
  const Manifest manifest = RequireArtifact(out, "ingest");
  EXPECT_EQ(manifest.facts.at("n_images"), 1 + static_cast<int>(names.size())) << result.err;
  std::vector<std::string> found;
  const Json capture = ReadJson(out / "capture.json");
  for (const Json& image : capture.at("images")) {
    const fs::path name = UnescapePath(image.at("path").get<std::string>());
    EXPECT_TRUE(fs::exists(dir / name)) << image.at("path");
  }
}

// --- The disk
// ---------------------------------------------------------------------------------------------------------

TEST(BadInput, OriginalsOfAReadOnlyFolderAreOnlyRead) {
  const TemporaryDirectory temporary;
  const fs::path dir = temporary.path() / "photos", out = temporary.path() / "ingest";
  WriteUnrelatedPhotos(dir, 5);
  for (const auto& entry : fs::directory_iterator(dir)) fs::permissions(entry.path(), fs::perms(0444));
  fs::permissions(dir, fs::perms(0555));
  const std::string before = HashTree(dir);
  const fs::file_time_type changed = fs::last_write_time(dir);
  EXPECT_EQ(RunProgram({"nrff-ingest", dir, "--out", out}).exit_code, 0);
  EXPECT_EQ(HashTree(dir), before);
  EXPECT_EQ(fs::last_write_time(dir), changed);
  fs::permissions(dir, fs::perms(0755));
}

// A file system with little room: a write beyond the limit fails as on a full disk (EFBIG in place of ENOSPC).
TEST(BadInput, DiskThatFillsUpIsAResourceErrorAndKeepsTheEarlierArtifact) {
  const TemporaryDirectory temporary;
  const fs::path capture = temporary.path() / "capture", ingest = temporary.path() / "ingest";
  const fs::path scene = temporary.path() / "pose";
  MakeExampleCapture(capture, {"--posed", "--views", "10", "--width", "96", "--height", "64", "--samples", "1"});
  ASSERT_EQ(RunProgram({"nrff-ingest", capture, "--out", ingest}).exit_code, 0);
  const std::vector<std::string> normalise = {"nrff-pose", "normalise", "--ingest", ingest, "--out", scene};
  ASSERT_EQ(RunProgram(normalise).exit_code, 0);
  const std::string before = HashTree(scene);
  // The pack of ten photos of 96 × 64 pixels is the first file that is larger.
  ExpectError(RunProgram(normalise, {.file_size_limit_bytes = 100'000}), ExitCode::kResource, {"images.u8"});
  EXPECT_EQ(HashTree(scene), before);
  EXPECT_EQ(RunProgram(normalise).exit_code, 0);
}

TEST(BadInput, FullDiskIsAResourceErrorAndKeepsWhatIsComplete) {
  const TemporaryDirectory temporary;
  const fs::path capture = temporary.path() / "capture", disk = temporary.path() / "disk";
  fs::create_directories(disk);
  MakeExampleCapture(capture, {"--posed", "--views", "10", "--width", "192", "--height", "128", "--samples", "1"});
  const std::string mount = "mount -t tmpfs -o size=400k none '" + disk.string() + "'";
  // In a mount namespace of its own, which ends with the command and takes the file system along.
  if (RunProgram({"/usr/bin/unshare", "-m", "/bin/sh", "-c", mount}).exit_code != 0) {
    GTEST_SKIP() << "mounting a small file system is not allowed here";
  }
  const std::string run =
      std::string(NRFF_BIN_DIR) + "/nrff run '" + capture.string() + "' -w '" + disk.string() + "/work' --until pose";
  const ProgramResult result = RunProgram({"/usr/bin/unshare", "-m", "/bin/sh", "-c",
                                           mount + " && { " + run + "; code=$?; test -s '" + disk.string() +
                                               "/work/ingest/manifest.json' || code=99; exit $code; }"});
  ExpectError(result, ExitCode::kResource, {"work/pose"});
}

// --- COLMAP
// -----------------------------------------------------------------------------------------------------------

class Colmap : public testing::Test {
 protected:
  void SetUp() override {
    WriteUnrelatedPhotos(photos_, 8, 320, 240);
    ASSERT_EQ(RunProgram({"nrff-ingest", photos_, "--out", ingest_}).exit_code, 0);
    // An earlier complete artifact in the place that the failing run is to write to.
    fs::create_directories(sfm_);
    fs::copy(ingest_, sfm_, fs::copy_options::recursive);
    before_ = HashTree(sfm_);
  }

  ProgramResult Estimate(const std::map<std::string, std::string>& environment,
                         const std::vector<std::string>& more = {}) const {
    std::vector<std::string> command = {"nrff-pose", "estimate", "--ingest", ingest_, "--out", sfm_};
    command.insert(command.end(), more.begin(), more.end());
    return RunProgram(command, {.environment = environment});
  }

  fs::path WriteScript(const std::string& body) const {
    fs::path script = temporary_.path() / "colmap.sh";
    WriteText(script, "#!/bin/sh\n" + body + "\n");
    fs::permissions(script, fs::perms(0755));
    return script;
  }

  TemporaryDirectory temporary_;
  fs::path photos_ = temporary_.path() / "photos", ingest_ = temporary_.path() / "ingest";
  fs::path sfm_ = temporary_.path() / "sfm";
  std::string before_;
};

TEST_F(Colmap, MissingIsAnExternalToolErrorThatNamesIt) {
  const fs::path nowhere = temporary_.path() / "no-such-colmap";
  ExpectError(Estimate({{"NRFF_COLMAP", nowhere}}), ExitCode::kExternalTool, {"no-such-colmap"});
  EXPECT_EQ(HashTree(sfm_), before_);
}

TEST_F(Colmap, FailingIsAnExternalToolErrorThatQuotesIt) {
  const fs::path script = WriteScript("echo 'SiftGPU not fully supported' >&2; exit 7");
  ExpectError(Estimate({{"NRFF_COLMAP", script}}), ExitCode::kExternalTool, {"olmap"});
  EXPECT_EQ(HashTree(sfm_), before_);
}

TEST_F(Colmap, HangingIsStoppedByTheWatchdog) {
  // Answers what is asked about it, then neither prints nor works.
  const fs::path script =
      WriteScript("case \"$*\" in *help*|*-h*) echo 'COLMAP 3.8 (Commit Unknown)';; *) sleep 1000;; esac");
  const ProgramResult result = Estimate({{"NRFF_COLMAP", script}}, {"--stall-limit", "1"});
  ExpectError(result, ExitCode::kExternalTool, {"olmap"});
  EXPECT_LT(result.seconds, 30);
  EXPECT_EQ(HashTree(sfm_), before_);
}

TEST_F(Colmap, PhotosWithoutOverlapAreAnInputErrorThatSaysSo) {
  if (RunProgram({"/bin/sh", "-c", "command -v colmap"}).exit_code != 0) GTEST_SKIP() << "colmap is not installed";
  ExpectError(Estimate({}), ExitCode::kInput, {"overlap"});
  EXPECT_EQ(HashTree(sfm_), before_);
}

TEST_F(Colmap, FailureOfOneCaptureDoesNotStopTheOthers) {
  const fs::path posed = temporary_.path() / "posed", work = temporary_.path() / "work";
  WritePosedCapture(posed, GoodMatrix);
  const fs::path nowhere = temporary_.path() / "no-such-colmap";
  const ProgramResult result = RunProgram({"nrff", "run", photos_, posed, "-w", work, "--until", "pose"},
                                          {.environment = {{"NRFF_COLMAP", nowhere}}});
  ExpectError(result, ExitCode::kExternalTool, {"sfm", "no-such-colmap"});
  EXPECT_TRUE(ReadManifest(work / "posed" / "pose").has_value());
  EXPECT_TRUE(ReadManifest(work / CaptureFolderName(photos_) / "ingest").has_value());
}

}  // namespace
}  // namespace nrff
