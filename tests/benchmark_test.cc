#include "pipeline/benchmark.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/manifest.h"
#include "pipeline/workspace.h"
#include "tests/temporary_directory.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::Not;

const DataSet& Named(const std::string& name) {
  for (const DataSet& data_set : DataSets()) {
    if (data_set.name == name) return data_set;
  }
  throw InputError("no data set " + name);
}

class BenchmarkTest : public testing::Test {
 protected:
  void Touch(const std::string& path) const {
    fs::create_directories((root_ / path).parent_path());
    WriteFileAtomically(root_ / path, "");
  }
  std::vector<std::string> SceneNames(const std::string& data_set) const {
    std::vector<std::string> names;
    for (const fs::path& scene : FindScenes(Named(data_set), root_)) names.push_back(scene.filename());
    return names;
  }

  void Make(const std::string& workspace, const std::string& stage, const Json& facts) const {
    ArtifactWriter artifact(stage, root_ / workspace / stage, {}, {});
    WriteFileAtomically(artifact.dir() / "payload", stage);
    artifact.AddOutput("payload");
    artifact.facts() = facts;
    artifact.Commit();
  }
  fs::path MakeWorkspace(const std::string& name, double psnr, int width, int height, const Json& lpips = {}) const {
    Workspace(root_ / name).WriteMarker({"/data/" + name, {}});
    Make(name, "ingest",
         {{"name", name}, {"posed", true}, {"split_rule", "the data set's own"}, {"width", 1920}, {"height", 1080}});
    Make(name, "pose", {{"width", width}, {"height", height}, {"n_views_test", 7}});
    Make(name, "train", {{"steps", 500}, {"preset", "small"}, {"seconds_training", 60.0}, {"device", "cpu"}});
    Make(name, "render", {{"seconds_per_view", 0.25}, {"samples_per_ray", 9.5}});
    Json protocol = {{"background", "white"}, {"bits", {{"truth", 8}, {"rendered", 16}}}};
    if (!lpips.is_null()) protocol["lpips"] = {{"network", "vgg"}, {"version", "0.1"}, {"hash", "h"}};
    Make(name, "eval",
         {{"psnr", psnr},
          {"ssim", 0.5 + psnr / 100},
          {"lpips", lpips},
          {"lpips_reason", "no file"},
          {"n_images", 7},
          {"variants", {{"psnr_pooled", psnr - 1}, {"psnr_quantised", psnr - 0.5}, {"psnr_foreground", nullptr}}},
          {"protocol", protocol}});
    return root_ / name;
  }

  TemporaryDirectory directory_;
  const fs::path root_ = fs::canonical(directory_.path());
};

TEST_F(BenchmarkTest, ScenesAreFoundByWhatTheyHold) {
  for (const char* file : {"Truck/intrinsics.txt", "Truck/pose/0_a.txt", "Barn/intrinsics.txt", "Barn/pose/0_a.txt",
                           "lego/transforms_train.json", "fern/sparse/0/cameras.bin", "fern/images/a.jpg",
                           "notes/readme.txt", "readme.txt"}) {
    Touch(file);
  }
  EXPECT_THAT(SceneNames("tanks-and-temples"), ElementsAre("Barn", "Truck"));
  EXPECT_THAT(SceneNames("nsvf-synthetic"), ElementsAre("Barn", "Truck"));
  EXPECT_THAT(SceneNames("nerf-synthetic"), ElementsAre("lego"));
  EXPECT_THAT(SceneNames("llff"), ElementsAre("fern"));
  EXPECT_THAT(FindScenes(Named("llff"), root_ / "fern"), ElementsAre(root_ / "fern"));
  try {
    FindScenes(Named("nerf-synthetic"), root_ / "fern");
    FAIL() << "accepted";
  } catch (const Error& error) {
    EXPECT_EQ(error.code(), ExitCode::kInput);
    EXPECT_THAT(error.what(), HasSubstr("none of its 2 folders has transforms_train.json"));
  }
  EXPECT_THROW(FindScenes(Named("llff"), root_ / "readme.txt"), Error);
}

TEST_F(BenchmarkTest, AnyCapturesMakeATableOfTheirOwn) {
  for (const char* file : {"fox/transforms.json", "castle/a.JPG", "maryrose/images/b.png", "notes/readme.txt"})
    Touch(file);
  EXPECT_THAT(SceneNames("captures"), ElementsAre("castle", "fox", "maryrose"));
  EXPECT_THAT(FindScenes(Named("captures"), root_ / "castle"), ElementsAre(root_ / "castle"));
  const std::string text = BenchmarkMarkdown(
      BenchmarkTable(Named("captures"), root_, {MakeWorkspace("fox", 20, 400, 225)}, "nrff benchmark captures DIR"));
  EXPECT_THAT(text, HasSubstr("| fox | 20.00 |"));
  EXPECT_THAT(text, HasSubstr("- Size in px: 400 × 225"));
  EXPECT_THAT(text, Not(HasSubstr("ublished")));
}

TEST_F(BenchmarkTest, PublishedScenesAreKnownWhateverTheirCase) {
  EXPECT_EQ(PublishedScene(Named("tanks-and-temples"), "barn"), "Barn");
  EXPECT_EQ(PublishedScene(Named("tanks-and-temples"), "Barn2"), "");
  for (const DataSet& data_set : DataSets()) {
    EXPECT_EQ(data_set.published.empty(), data_set.name == "captures");
    for (size_t i = 1; i < data_set.published.size(); ++i) {
      EXPECT_GE(data_set.published[i - 1].psnr, data_set.published[i].psnr) << data_set.name << " " << i;
    }
  }
}

TEST_F(BenchmarkTest, TheTableHasEveryFigureTheMeansAndWhatDiffers) {
  const fs::path barn = MakeWorkspace("barn", 30, 1920, 1080), fox = MakeWorkspace("fox", 20, 400, 225);
  const Json table = BenchmarkTable(Named("tanks-and-temples"), root_, {barn, fox},
                                    "nrff benchmark tanks-and-temples DIR --budget 60s");
  EXPECT_EQ(table["mean"]["psnr"], 25);
  EXPECT_EQ(table["mean"]["ssim"], 0.75);
  EXPECT_TRUE(table["mean"]["lpips"].is_null());
  EXPECT_EQ(table["mean"]["variants"]["psnr_pooled"], 24);
  EXPECT_EQ(table["mean"]["n_scenes"], 2);
  EXPECT_EQ(table["scenes"][0]["published"], true);
  EXPECT_EQ(table["scenes"][1]["published"], false);
  EXPECT_EQ(table["scenes"][1]["workspace"], "fox");
  EXPECT_EQ(table["missing"], Json({"Caterpillar", "Family", "Ignatius", "Truck"}));
  const std::string differences = table["differences"].dump();
  EXPECT_THAT(differences, HasSubstr("4 of the 5"));
  EXPECT_THAT(differences, HasSubstr("not over fox"));
  EXPECT_THAT(differences,
              HasSubstr("Size in px: 400 × 225, area average of 1920 × 1080 (fox); published: 1920 × 1080"));
  EXPECT_THAT(differences, HasSubstr("preset small, 500 steps in 60.0 s on the CPU"));
  EXPECT_THAT(differences, HasSubstr("photos of 8 bits, renders of 16"));
  EXPECT_THAT(differences, HasSubstr("LPIPS: not measured, since no file"));
  EXPECT_THAT(differences, Not(HasSubstr("Background")));

  const std::string text = BenchmarkMarkdown(table);
  EXPECT_THAT(text, HasSubstr("| barn | 30.00 | 0.800 | – | 7 | 1920 × 1080 | 60.0 | 500 | small | 0.250 |"));
  EXPECT_THAT(text, HasSubstr("| **mean of 2** | 25.00 | 0.750 | – |"));
  EXPECT_THAT(text, HasSubstr("| NRFF, 60K steps | 29.05 | 0.931 | 0.119 |"));
  EXPECT_THAT(text, HasSubstr("Command: `nrff benchmark tanks-and-temples DIR --budget 60s`"));

  WriteBenchmark(root_, table);
  EXPECT_EQ(ReadJson(root_ / "benchmark.json"), table);
  EXPECT_EQ(ReadFile(root_ / "benchmark.md"), text);
  EXPECT_THAT(ReadFile(root_ / "benchmark.html"), HasSubstr("Tanks &amp; Temples"));
}

TEST_F(BenchmarkTest, ASceneWithoutFiguresIsLeftOutOfTheMeans) {
  const fs::path barn = MakeWorkspace("barn", 30, 1920, 1080, 0.125);
  const Workspace broken(root_ / "truck");
  broken.WriteMarker({"/data/truck", {}});
  broken.Record("ingest", {false, 3, "no photo | can be read"});
  const Json table = BenchmarkTable(Named("tanks-and-temples"), root_, {barn, broken.root()}, "");
  EXPECT_EQ(table["mean"]["psnr"], 30);
  EXPECT_EQ(table["mean"]["lpips"], 0.125);
  EXPECT_EQ(table["mean"]["n_scenes"], 1);
  EXPECT_EQ(table["scenes"][1]["status"], "failed");
  EXPECT_THAT(table["differences"].dump(), HasSubstr("LPIPS: vgg 0.1 (barn)"));
  EXPECT_THAT(table["differences"].dump(), Not(HasSubstr("Background")));
  EXPECT_THAT(table["differences"].dump(), Not(HasSubstr("0 images")));
  EXPECT_THAT(BenchmarkMarkdown(table), HasSubstr("| truck | failed: no photo \\| can be read |||"));
}

}  // namespace
}  // namespace nrff
