// Laws of the artifact library: files are replaced whole or not at all, names survive, manifests say what is there.
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cmath>
#include <csignal>
#include <fstream>
#include <limits>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"
#include "pipeline/manifest.h"
#include "pipeline/scene.h"
#include "tests/temporary_directory.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;
using ::testing::HasSubstr;

void Write(const fs::path& path, const std::string& bytes) {
  fs::create_directories(path.parent_path());
  std::ofstream(path, std::ios::binary) << bytes;
}

ExitCode CodeOf(const std::function<void()>& body) {
  try {
    body();
  } catch (const Error& error) {
    return error.code();
  }
  return ExitCode::kDone;
}

TEST(EscapePath, IsReversibleForEveryByte) {
  std::string name;
  for (int byte = 1; byte < 256; ++byte) name += static_cast<char>(byte);
  EXPECT_EQ(UnescapePath(EscapePath(name)).native(), name);
}

TEST(EscapePath, KeepsUtf8AndEscapesWhatIsNot) {
  EXPECT_EQ(EscapePath("Größe 1.jpg"), "Größe 1.jpg");
  EXPECT_EQ(EscapePath("a\nb\xFF%"), "a%0Ab%FF%25");
  EXPECT_EQ(EscapePath("\xC0\x80"), "%C0%80") << "an overlong form is not UTF-8";
  EXPECT_EQ(EscapePath("\xED\xA0\x80"), "%ED%A0%80") << "a surrogate is not UTF-8";
}

TEST(CaptureFolderName, LooksPastFoldersThatOnlySayWhatIsInThem) {
  EXPECT_EQ(CaptureFolderName("/a/fox/images"), "fox");
  EXPECT_EQ(CaptureFolderName("/a/fox"), "fox");
  EXPECT_EQ(CaptureFolderName("/images"), "images");
}

TEST(WriteFileAtomically, LeavesTheOldBytesWhenTheDiskIsFull) {
  const TemporaryDirectory dir;
  const fs::path path = dir.path() / "value";
  WriteFileAtomically(path, "old");
  const pid_t child = fork();
  if (child == 0) {  // a file size limit stands in for a full disk
    signal(SIGXFSZ, SIG_IGN);
    const rlimit limit{100, 100};
    setrlimit(RLIMIT_FSIZE, &limit);
    const ExitCode code = CodeOf([&] { WriteFileAtomically(path, std::string(1000, 'x')); });
    _exit(code == ExitCode::kResource ? 0 : 1);
  }
  int status = 0;
  waitpid(child, &status, 0);
  EXPECT_EQ(status, 0);
  EXPECT_EQ(ReadFile(path), "old");
  EXPECT_EQ(std::distance(fs::directory_iterator(dir.path()), {}), 1) << "the temporary file is gone";
}

TEST(ListFiles, VisitsLoopsOnceAndPassesOverWorkspacesAndHiddenFiles) {
  const TemporaryDirectory dir;
  Write(dir.path() / "b/2.jpg", "2");
  Write(dir.path() / "a.jpg", "1");
  Write(dir.path() / ".hidden/3.jpg", "3");
  Write(dir.path() / "work/scene/nrff-workspace.json", "{}");
  Write(dir.path() / "work/scene/4.png", "4");
  fs::create_directory_symlink(dir.path(), dir.path() / "b/loop");
  fs::create_symlink("dangling", dir.path() / "c.jpg");
  EXPECT_THAT(ListFiles(dir.path()), testing::ElementsAre(dir.path() / "a.jpg", dir.path() / "b/2.jpg"));
}

TEST(HashTree, ChangesWithContentsAndNamesButNotWithTime) {
  const TemporaryDirectory dir;
  Write(dir.path() / "a", "1");
  const std::string before = HashTree(dir.path());
  fs::last_write_time(dir.path() / "a", fs::file_time_type::clock::now() + std::chrono::hours(1));
  EXPECT_EQ(HashTree(dir.path()), before);
  Write(dir.path() / "a", "2");
  EXPECT_NE(HashTree(dir.path()), before);
  Write(dir.path() / "a", "1");
  fs::rename(dir.path() / "a", dir.path() / "b");
  EXPECT_NE(HashTree(dir.path()), before);
}

TEST(Artifact, AppearsOnlyWhenCommitted) {
  const TemporaryDirectory dir;
  const fs::path out = dir.path() / "ingest";
  ArtifactWriter writer("ingest", out, {{"seed", "1"}}, {});
  Write(writer.dir() / "data.bin", "payload");
  EXPECT_FALSE(ReadManifest(out));
  writer.AddOutput("data.bin");
  writer.facts()["n_images"] = 3;
  writer.Commit();
  const Manifest manifest = RequireArtifact(out, "ingest");
  EXPECT_EQ(manifest.params.at("seed"), "1");
  EXPECT_EQ(manifest.facts["n_images"], 3);
  ASSERT_EQ(manifest.outputs.size(), 1u);
  EXPECT_EQ(manifest.outputs[0].hash, HashBytes("payload"));
  EXPECT_FALSE(fs::exists(writer.dir()));
}

TEST(Artifact, ThatFailsLeavesTheLastCompleteOne) {
  const TemporaryDirectory dir;
  const fs::path out = dir.path() / "pose";
  const auto make = [&](const std::string& bytes, bool commit) {
    ArtifactWriter writer("pose", out, {}, {});
    Write(writer.dir() / "data", bytes);
    writer.AddOutput("data");
    if (commit) writer.Commit();
  };
  make("first", true);
  make("second", false);
  EXPECT_EQ(ReadFile(out / "data"), "first");
  make("third", true);
  EXPECT_EQ(ReadFile(out / "data"), "third");
}

TEST(Artifact, GoesOnFromAnAttemptWithTheSameParamsOnly) {
  const TemporaryDirectory dir;
  const fs::path out = dir.path() / "train";
  {
    ArtifactWriter writer("train", out, {{"steps", "10"}}, {}, ArtifactWriter::kKeepPartial);
    EXPECT_FALSE(writer.resumed());
    Write(writer.dir() / "checkpoint", "at step 5");
  }
  {
    const ArtifactWriter same("train", out, {{"steps", "10"}}, {}, ArtifactWriter::kKeepPartial);
    EXPECT_TRUE(same.resumed());
    EXPECT_EQ(ReadFile(same.dir() / "checkpoint"), "at step 5");
  }
  const ArtifactWriter other("train", out, {{"steps", "20"}}, {}, ArtifactWriter::kKeepPartial);
  EXPECT_FALSE(other.resumed());
  EXPECT_FALSE(fs::exists(other.dir() / "checkpoint"));
}

// Killed while it wrote a picture: its half-written file must not become part of the artifact.
TEST(Artifact, ThatGoesOnLeavesOutHalfWrittenFiles) {
  const TemporaryDirectory temporary;
  const fs::path out = temporary.path() / "render";
  const auto finish = [&](ArtifactWriter& writer) {
    WriteFileAtomically(writer.dir() / "rgb" / "2.png", "second");
    writer.AddOutput("rgb");
    writer.Commit();
    return ReadManifest(out)->ContentHash();
  };
  const auto begin = [&](ArtifactWriter& writer) {
    fs::create_directories(writer.dir() / "rgb");
    WriteFileAtomically(writer.dir() / "rgb" / "1.png", "first");
    WriteFileAtomically(writer.dir() / "rgb" / "my.tmp.png", "not a temporary file");
    writer.SaveSeconds();
  };
  {
    ArtifactWriter killed("render", out, {}, {}, ArtifactWriter::kKeepPartial);
    begin(killed);
    WriteFileAtomically(killed.dir() / "rgb" / "2.png.tmp12345", "sec");
  }
  ArtifactWriter again("render", out, {}, {}, ArtifactWriter::kKeepPartial);
  ASSERT_TRUE(again.resumed());
  const std::string resumed = finish(again);
  fs::remove_all(out);
  ArtifactWriter undisturbed("render", out, {}, {}, ArtifactWriter::kKeepPartial);
  begin(undisturbed);
  EXPECT_EQ(resumed, finish(undisturbed));
}

TEST(Artifact, ContentHashIgnoresTimesAndLogs) {
  const TemporaryDirectory dir;
  std::string hashes[2];
  for (int i = 0; i < 2; ++i) {
    ArtifactWriter writer("eval", dir.path() / std::to_string(i), {}, {});
    Write(writer.dir() / "data", "same");
    Write(writer.dir() / "log", std::to_string(i));
    writer.facts()["seconds"] = i;
    writer.AddOutput("data");
    writer.Commit();
    hashes[i] = ReadManifest(dir.path() / std::to_string(i))->ContentHash();
  }
  EXPECT_EQ(hashes[0], hashes[1]);
}

TEST(Artifact, ReportsDamage) {
  const TemporaryDirectory dir;
  const fs::path out = dir.path() / "train";
  EXPECT_EQ(CodeOf([&] { RequireArtifact(out, "train"); }), ExitCode::kInput);
  ArtifactWriter writer("train", out, {}, {});
  Write(writer.dir() / "model", "payload");
  writer.AddOutput("model");
  writer.Commit();
  EXPECT_EQ(CodeOf([&] { RequireArtifact(out, "pose"); }), ExitCode::kInput);
  Write(out / "model", "pay");
  EXPECT_EQ(CodeOf([&] { RequireArtifact(out, "train"); }), ExitCode::kCorrupt);
  Write(out / kManifestName, R"({"schema_version": 99})");
  EXPECT_EQ(CodeOf([&] { ReadManifest(out); }), ExitCode::kCorrupt);
  // Cut at every byte, a manifest is either read whole or reported.
  const std::string whole = Json(Manifest{}).dump();
  for (size_t n = 0; n < whole.size(); ++n) {
    Write(out / kManifestName, whole.substr(0, n));
    EXPECT_EQ(CodeOf([&] { ReadManifest(out); }), ExitCode::kCorrupt) << n;
  }
}

TEST(Json, RefusesToReadWhatCannotBeUsed) {
  const TemporaryDirectory dir;
  const auto message = [&](const std::string& text) {
    Write(dir.path() / "a", text);
    try {
      ReadJson(dir.path() / "a");
    } catch (const Error& error) {
      EXPECT_EQ(error.code(), ExitCode::kCorrupt);
      return std::string(error.what());
    }
    return std::string();
  };
  // Copying or printing so many levels would end the program.
  EXPECT_THAT(message(std::string(1'000'000, '[')), testing::HasSubstr("within each other"));
  EXPECT_EQ(message(std::string(kMostJsonLevels, '[') + std::string(kMostJsonLevels, ']')), "");
  EXPECT_NO_THROW(Json(message("\"\xFF")).dump());  // no bytes in the message that JSON cannot hold
  EXPECT_THROW(ParseJson(R"({"a": {"b": 1, "b": 2}})", RepeatedKeys::kRefuse), JsonSyntaxError);
  EXPECT_NO_THROW(ParseJson(R"({"a": {"b": 1}, "b": 2})", RepeatedKeys::kRefuse));
}

TEST(Json, WholeNumbersBeyondTheirTypeAreErrors) {
  const Json json = {{"most", 2147483647}, {"over", 2147483648}, {"minus", -1}, {"half", 0.5}, {"huge", 1e300}};
  EXPECT_EQ(Get<int>(json, "most", "x"), 2147483647);
  EXPECT_EQ(Get<int64_t>(json, "over", "x"), 2147483648);
  EXPECT_EQ(Get<double>(json, "over", "x"), 2147483648.0);
  for (const char* key : {"over", "half", "huge"}) {
    EXPECT_EQ(CodeOf([&] { Get<int>(json, key, "x"); }), ExitCode::kCorrupt) << key;
  }
  EXPECT_EQ(CodeOf([&] { Get<uint64_t>(json, "minus", "x"); }), ExitCode::kCorrupt);
}

TEST(Files, FileNamesAreNoPaths) {
  for (const char* name : {"000012", "a b.png", "..."}) EXPECT_TRUE(IsFileName(name)) << name;
  for (const std::string name : {"", ".", "..", "a/b", "/a", "a\nb"}) EXPECT_FALSE(IsFileName(name)) << name;
  EXPECT_FALSE(IsFileName(std::string(300, 'a')));
}

TEST(Json, RefusesToWriteWhatItCannotHold) {
  const TemporaryDirectory dir;
  EXPECT_EQ(CodeOf([&] { WriteJson(dir.path() / "a", {{"x", {1.0, std::nan("")}}}); }), ExitCode::kInput);
  EXPECT_FALSE(fs::exists(dir.path() / "a"));
}

class SceneTest : public testing::Test {
 protected:
  SceneTest() {
    View view;
    view.id = "000000";
    view.name = "a.jpg";
    view.width = 2;
    view.height = 1;
    view.fx = view.fy = 2;
    view.cx = 1;
    view.cy = 0.5;
    view.scene_from_camera = kIdentity;
    scene_.scene_from_world = {0, -2, 0, 1, 2, 0, 0, 2, 0, 0, 2, 3, 0, 0, 0, 1};
    scene_.views = {view};
    Write(dir_.path() / kPackFile, "abcdef");
  }
  ExitCode RoundTrip() {
    return CodeOf([&] {
      SaveScene(scene_, dir_.path());
      LoadScene(dir_.path());
    });
  }
  static constexpr Mat4 kIdentity = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
  TemporaryDirectory dir_;
  Scene scene_;
};

TEST_F(SceneTest, SurvivesTheRoundTrip) {
  SaveScene(scene_, dir_.path());
  const Scene loaded = LoadScene(dir_.path());
  EXPECT_EQ(loaded.scene_from_world, scene_.scene_from_world);
  EXPECT_EQ(loaded.views[0].scene_from_camera, kIdentity);
  const ImagePack pack(dir_.path());
  EXPECT_EQ(pack.Pixels(loaded.views[0])[3], 'd');
}

TEST_F(SceneTest, RefusesAMirroredCamera) {
  scene_.views[0].scene_from_camera[0] = -1;
  EXPECT_EQ(RoundTrip(), ExitCode::kInput);
}

TEST_F(SceneTest, RefusesAViewOutsideThePack) {
  scene_.views[0].pack_offset = 1;
  EXPECT_EQ(RoundTrip(), ExitCode::kCorrupt);
  scene_.views[0].pack_offset = std::numeric_limits<uint64_t>::max();
  EXPECT_EQ(RoundTrip(), ExitCode::kCorrupt);
}

TEST_F(SceneTest, RefusesNumbersThatAreNotFinite) {
  scene_.views[0].scene_from_camera[3] = std::nan("");
  EXPECT_EQ(RoundTrip(), ExitCode::kInput);
}

TEST(InverseSimilarity, ComposesToTheIdentity) {
  const Mat4 m = {0, -2, 0, 1, 2, 0, 0, 2, 0, 0, 2, 3, 0, 0, 0, 1};
  const Mat4 product = Multiply(m, InverseSimilarity(m));
  for (int i = 0; i < 16; ++i) EXPECT_NEAR(product[i], i % 5 == 0 ? 1 : 0, 1e-15);
}

}  // namespace
}  // namespace nrff
