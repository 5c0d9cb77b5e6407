#include "pipeline/report.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <unistd.h>

#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <map>
#include <set>
#include <sstream>
#include <utility>

#include "pipeline/files.h"
#include "pipeline/manifest.h"
#include "pipeline/report_content.h"
#include "pipeline/report_page.h"
#include "pipeline/report_summary.h"
#include "pipeline/scene.h"
#include "pipeline/workspace.h"
#include "tests/program.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;
using testing::Not;

constexpr char kAwkwardName[] = "a \"b\" </script><img src=x onerror=alert(1)>'&.jpg";

TEST(Base64, MatchesTheTestVectorsOfRfc4648) {
  EXPECT_EQ(Base64(""), "");
  EXPECT_EQ(Base64("f"), "Zg==");
  EXPECT_EQ(Base64("fo"), "Zm8=");
  EXPECT_EQ(Base64("foo"), "Zm9v");
  EXPECT_EQ(Base64("foobar"), "Zm9vYmFy");
  EXPECT_EQ(Base64("\xff\xfe\xfd"), "//79");
}

TEST(FillPage, NoTextFromTheDataBecomesMarkup) {
  const std::string page = FillPage("report.html", kAwkwardName, {{"name", kAwkwardName}, {"comment", "<!--"}});
  EXPECT_THAT(page, Not(HasSubstr("<img src=x")));
  EXPECT_THAT(page, Not(HasSubstr("\"<!--")));
  EXPECT_THAT(page, HasSubstr("&lt;/script&gt;&lt;img"));
  const size_t start = page.find("id=\"data\">") + std::strlen("id=\"data\">");
  const Json data = Json::parse(page.substr(start, page.find("</script>", start) - start));
  EXPECT_EQ(data["name"], kAwkwardName);
  EXPECT_EQ(data["comment"], "<!--");
}

TEST(FillPage, PagesAreSelfContainedAndHaveNoPlaceholderLeft) {
  for (const char* name :
       {"report.html", "joint.html", "benchmark.html", "work_precision.html", "ablation.html", "stability.html"}) {
    const std::string page = FillPage(name, "title", Json::object());
    for (const char* outside : {"{{", "<link", "src=\"", "https://", "@import", "url("}) {
      EXPECT_THAT(page, Not(HasSubstr(outside))) << name;
    }
    EXPECT_THAT(page, HasSubstr("prefers-color-scheme: dark"));
  }
}

class ReportTest : public testing::Test {
 protected:
  void SetUp() override {
    folder_ = fs::temp_directory_path() / ("nrff_report_" + std::to_string(getpid()) + "_" +
                                           testing::UnitTest::GetInstance()->current_test_info()->name());
    fs::remove_all(folder_);
    root_ = folder_ / "fox";
    Workspace(root_).WriteMarker({"/photos/fox", {}});
  }
  void TearDown() override { fs::remove_all(folder_); }

  // An artifact with the files given and the facts.
  void Make(const std::string& stage, const Json& facts, const std::map<std::string, std::string>& files = {},
            const std::vector<Decision>& decisions = {}, const Params& params = {}) const {
    ArtifactWriter artifact(stage, root_ / stage, params, {});
    for (const auto& [name, bytes] : files) {
      fs::create_directories((artifact.dir() / name).parent_path());
      WriteFileAtomically(artifact.dir() / name, bytes);
      artifact.AddOutput(name);
    }
    artifact.facts() = facts;
    for (const Decision& decision : decisions) artifact.AddDecision(decision);
    artifact.Commit();
  }

  void MakeIngest(bool posed = false) const {
    Make("ingest", {{"name", "fox"},
                    {"n_images", 10},
                    {"n_train", 8},
                    {"n_test", 2},
                    {"split_rule", "every 8th by file name"},
                    {"posed", posed},
                    {"rejected", {{{"name", kAwkwardName}, {"reason", "is text"}}}},
                    {"duplicates", {{"a.jpg", "b.jpg"}}}});
  }

  void MakeSfm(int n_registered) const {
    Make("sfm",
         {{"colmap_version", "3.8"},
          {"n_registered", n_registered},
          {"n_images", 10},
          {"unregistered", {"c.jpg"}},
          {"groups",
           {{{"n_images", n_registered}, {"n_points", 99}, {"photos", "a.jpg to e.jpg"}},
            {{"n_images", 3}, {"n_points", 7}, {"photos", "g.jpg to i.jpg"}}}},
          {"field_of_view_deg", 160.4},
          {"groups_advice", "No photo of one group matches any of another"}},
         {{"colmap.log", "log"}}, {needs::Sfm(false, "photos")});
  }

  void MakePose() const {
    Scene scene;
    scene.scene_from_world = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
    View view;
    view.id = "000000";
    view.name = kAwkwardName;
    view.split = Split::kTest;
    view.width = 2, view.height = 1;
    view.fx = view.fy = 2, view.cx = 1, view.cy = 0.5;
    view.scene_from_camera = scene.scene_from_world;
    view.scene_from_camera[3] = 2;
    scene.views = {view};
    fs::create_directories(folder_ / "scene");
    SaveScene(scene, folder_ / "scene");
    const float positions[2][3] = {{1, 2, 3}, {-4, 5, 6}};
    std::string points = "ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\nend_header\n";
    for (const auto& position : positions) {
      points.append(reinterpret_cast<const char*>(position), sizeof position);
      points += "\x01\x02\x03";
    }
    Make("pose", {{"n_views_train", 7}, {"n_views_test", 1}, {"unregistered", {"c.jpg"}}},
         {{"scene.json", ReadFile(folder_ / "scene" / "scene.json")}, {"images.u8", "RGBRGB"}, {"points.ply", points}});
  }

  void MakeTrain() const {
    Make("train",
         {{"steps", 120},
          {"samples", 4500},
          {"preset", "quick"},
          {"device", "cpu"},
          {"threads", 2},
          {"n_parameters", 1000},
          {"seconds_training", 12.5},
          {"settings", {{"levels", 8}}},
          {"curve",
           {{{"seconds", 6.0}, {"steps", 60}, {"samples", 2000}, {"psnr", 20.0}, {"train_psnr", 21.0}},
            {{"seconds", 12.5}, {"steps", 120}, {"samples", 4500}, {"psnr", 25.0}, {"train_psnr", 27.0}}}}},
         {{"model.safetensors", std::string(77, 'm')}}, {}, {{"preset", "quick"}});
  }

  static std::string Name(int i) { return std::to_string(i) + kAwkwardName; }

  // `n` scored views with PSNR 20, 21, …; pictures are one-byte files that hold the view's number.
  void MakeRenderAndEval(int n, int side = 2) const {
    std::map<std::string, std::string> renders, scores;
    Json images = Json::array();
    for (int i = 0; i < n; ++i) {
      const std::string file = std::to_string(i) + ".png", byte(1, char('A' + i));
      for (const char* layer : {"rgb/", "depth/", "normal/"}) renders[layer + file] = byte;
      for (const char* layer : {"truth/", "error/"}) scores[layer + file] = byte;
      images.push_back({{"id", std::to_string(i)},
                        {"name", Name(i)},
                        {"width", side},
                        {"height", side},
                        {"psnr", 20 + i},
                        {"ssim", 0.5},
                        {"lpips", nullptr},
                        {"truth", "truth/" + file},
                        {"rendered", "../render/rgb/" + file},
                        {"error", "error/" + file}});
    }
    const Json metrics = {{"psnr", 20.5}, {"ssim", 0.5}, {"lpips", nullptr}, {"lpips_reason", "none"}, {"n_images", n}};
    scores["metrics.json"] = Json({{"schema_version", 1}, {"metrics", metrics}, {"images", images}}).dump();
    Make("render", {{"n_views", n}}, renders);
    Json facts = metrics;
    facts["protocol"] = {{"range", {0, 1}}};
    Make("eval", facts, scores);
  }

  void MakeAll() const {
    MakeIngest();
    MakeSfm(9);
    MakePose();
    MakeTrain();
    MakeRenderAndEval(2);
  }

  Json WriteAndReadSummary() const {
    WriteReport(root_);
    return ReadJson(root_ / "report" / "summary.json");
  }

  Json PageData(const fs::path& page) const {
    const std::string text = ReadFile(page);
    const size_t start = text.find("id=\"data\">") + std::strlen("id=\"data\">");
    return Json::parse(text.substr(start, text.find("</script>", start) - start));
  }

  static std::set<std::string> WarningKinds(const Json& summary) {
    std::set<std::string> kinds;
    for (const Json& warning : summary["warnings"]) kinds.insert(warning["kind"]);
    return kinds;
  }

  fs::path folder_, root_;
};

TEST_F(ReportTest, SummaryHasEveryFieldOfTheSchema) {
  MakeAll();
  Workspace(root_).Record("sfm", {true, 0, ""});
  const Json summary = WriteAndReadSummary();
  EXPECT_EQ(summary["schema_version"], 1);
  EXPECT_EQ(summary["status"], "complete");
  EXPECT_TRUE(summary["failure"].is_null());
  EXPECT_EQ(summary["metrics"]["psnr"], 20.5);
  EXPECT_EQ(summary["metrics"]["ssim"], 0.5);
  EXPECT_TRUE(summary["metrics"]["lpips"].is_null());
  EXPECT_EQ(summary["split"]["train"], 8);
  EXPECT_EQ(summary["split"]["test"], 2);
  EXPECT_EQ(summary["split"]["registered"], 9);
  ASSERT_EQ(summary["images"].size(), 2);
  for (const Json& image : summary["images"]) {
    EXPECT_EQ(image["name"], Name(int(&image - &summary["images"][0])));
    for (const char* key : {"rendered", "truth", "error"}) {
      EXPECT_TRUE(fs::exists(root_ / std::string(image[key]))) << image[key];
    }
  }
  ASSERT_EQ(summary["decisions"].size(), 1);
  for (const char* key : {"feature", "needed", "evidence", "threshold", "reason"}) {
    EXPECT_TRUE(summary["decisions"][0].contains(key)) << key;
  }
  ASSERT_EQ(summary["stages"].size(), 6);
  for (const Json& stage : summary["stages"]) {
    EXPECT_GT(stage["peak_memory_bytes"], 0);
    EXPECT_GE(stage["seconds"], 0);
    EXPECT_EQ(stage["reused"], stage["name"] == "sfm");
  }
  EXPECT_EQ(summary["training"]["steps"], 120);
  EXPECT_EQ(summary["training"]["samples"], 4500);
  EXPECT_EQ(summary["training"]["model_bytes"], 77);
  ASSERT_EQ(summary["training"]["curve"].size(), 2);
  for (const char* key : {"seconds", "steps", "samples", "psnr"}) {
    EXPECT_TRUE(summary["training"]["curve"][1].contains(key)) << key;
  }
  EXPECT_EQ(summary["settings"]["training"]["levels"], 8);
  EXPECT_EQ(summary["settings"]["options"]["train"]["preset"], "quick");
  EXPECT_EQ(summary["versions"]["nrff"], Version());
  EXPECT_EQ(summary["versions"]["colmap"], "3.8");
}

TEST_F(ReportTest, IsAnArtifactMadeFromAllOthers) {
  MakeAll();
  WriteReport(root_);
  const Manifest manifest = RequireArtifact(root_ / "report", "report");
  EXPECT_EQ(manifest.inputs.size(), 6);
  EXPECT_EQ(manifest.outputs.size(), 2);
}

// What sfm says of its model: of the one camera that the scene has, and of one that it has not.
Json Refinement() {
  const auto image = [](const char* id, double position, double rotation) {
    return Json{{"name", id}, {"position_deviation", position}, {"rotation_deviation_deg", rotation}};
  };
  const Json errors = {{"median", 0.5}, {"mean", 0.7}};
  return {{"schema_version", 1},
          {"reason", nullptr},
          {"degeneracy", "the images do not fix the focal length of camera 1"},
          {"structure", {"planar: the points lie on a plane"}},
          {"n_points", 30},
          {"n_observations", 100},
          {"left_out",
           {{"images", {"000000"}}, {"n_points", 4}, {"n_observations_behind", 5}, {"n_observations_beyond_lens", 6}}},
          {"components", {{{"images", {"a"}}}, {{"images", {"b", "c"}}}}},
          {"track_lengths", {{"10", 7}, {"2", 20}, {"3", 3}}},
          {"reprojection_error_px", {{"before", errors}, {"after", errors}}},
          {"iterations", 9},
          {"converged", true},
          {"remaining_deviations", 1e-4},
          {"images", {image("000000", 0.5, 0.25), image("000007", 1, 1)}}};
}

TEST_F(ReportTest, PageSaysHowWellTheCamerasAreKnown) {
  MakeAll();
  WriteReport(root_);
  EXPECT_TRUE(PageData(root_ / "report" / "report.html")["certificate"].is_null());
  WriteJson(root_ / "sfm" / "refinement.json", Refinement());
  WriteReport(root_);
  const Json certificate = PageData(root_ / "report" / "report.html")["certificate"];
  // Half a unit of the world, which the scene leaves as it is, at a distance of two.
  EXPECT_EQ(certificate["cameras"],
            Json({{{"name", kAwkwardName}, {"split", "test"}, {"position", 0.25}, {"rotation_deg", 0.25}}}));
  EXPECT_EQ(certificate["track_lengths"][2], Json({{"length", 10}, {"n", 7}}));  // by number, not by name
  EXPECT_EQ(certificate["components"], Json({2, 1}));
  EXPECT_EQ(certificate["n_left_out"], Json({{"points", 4}, {"behind", 5}, {"beyond_lens", 6}}));
  ASSERT_EQ(certificate["left_out"].size(), 3);
  EXPECT_EQ(certificate["left_out"][0]["reason"], "is text");
  EXPECT_EQ(certificate["left_out"][1]["name"], "c.jpg");
  EXPECT_EQ(certificate["left_out"][2]["name"], kAwkwardName);

  Json damaged = Refinement();
  damaged["components"] = "none";
  WriteJson(root_ / "sfm" / "refinement.json", damaged);
  EXPECT_THAT(WarningKinds(WriteAndReadSummary()), testing::Contains("damaged files"));
}

TEST_F(ReportTest, PageHoldsPicturesCamerasAndPoints) {
  MakeAll();
  WriteReport(root_);
  const Json data = PageData(root_ / "report" / "report.html");
  ASSERT_EQ(data["pictures"]["views"].size(), 2);
  for (const char* layer : {"truth", "rendered", "error", "depth", "normal"}) {
    EXPECT_EQ(data["pictures"]["views"][1][layer], "data:image/png;base64,Qg==") << layer;
  }
  EXPECT_EQ(data["geometry"]["points"]["n"], 2);
  EXPECT_EQ(data["geometry"]["points"]["colors"], Base64("\x01\x02\x03\x01\x02\x03"));
  EXPECT_EQ(data["geometry"]["cameras"][0]["name"], kAwkwardName);
  EXPECT_EQ(data["geometry"]["cameras"][0]["slope_x"], 0.5);
}

TEST_F(ReportTest, OfManyOrLargeViewsOnlyWorstMedianAndBestAreEmbedded) {
  MakeIngest();
  for (const auto& [n, side] : {std::pair{int(kMaxPictureViews) + 1, 2}, {5, kMaxPictureSidePx + 1}}) {
    MakeRenderAndEval(n, side);
    WriteReport(root_);
    const Json data = PageData(root_ / "report" / "report.html");
    ASSERT_EQ(data["pictures"]["views"].size(), 3) << n;
    EXPECT_EQ(data["pictures"]["views"][0]["image"], 0);
    EXPECT_EQ(data["pictures"]["views"][1]["image"], n / 2);
    EXPECT_EQ(data["pictures"]["views"][2]["image"], n - 1);
    EXPECT_THAT(data["pictures"]["note"].get<std::string>(), HasSubstr("3 of " + std::to_string(n)));
    EXPECT_EQ(data["summary"]["images"].size(), n);
  }
}

TEST_F(ReportTest, WarnsOfEverythingThatLimitsTheFigures) {
  MakeIngest();
  MakeSfm(5);
  MakePose();
  const Json summary = WriteAndReadSummary();
  EXPECT_EQ(WarningKinds(summary),
            (std::set<std::string>{"low registration", "held-out photos without a pose", "unregistered photos",
                                   "several groups", "wide lens", "rejected photos", "duplicates"}));
  for (const Json& warning : summary["warnings"]) {
    if (warning["kind"] != "several groups") continue;
    EXPECT_THAT(warning["text"].get<std::string>(), HasSubstr("No photo of one group matches any of another"));
    EXPECT_EQ(warning["items"][1], "3 photos, 7 points: g.jpg to i.jpg");
  }
}

TEST_F(ReportTest, StageThatFailedIsNamedWithItsError) {
  MakeIngest();
  Workspace(root_).Record("sfm", {false, 3, "Only 2 of 10 photos could be placed."});
  const Json summary = WriteAndReadSummary();
  EXPECT_EQ(summary["status"], "failed");
  EXPECT_EQ(summary["failure"]["stage"], "sfm");
  EXPECT_EQ(summary["failure"]["error"], "Only 2 of 10 photos could be placed.");
  EXPECT_EQ(summary["stages"].size(), 1);
  EXPECT_TRUE(summary["metrics"]["psnr"].is_null());
  EXPECT_EQ(summary["images"], Json::array());
  EXPECT_EQ(summary["training"]["curve"], Json::array());
}

TEST_F(ReportTest, EmptyWorkspaceGivesAReport) {
  const Json summary = WriteAndReadSummary();
  EXPECT_EQ(summary["status"], "incomplete");
  EXPECT_EQ(summary["name"], "fox");
  EXPECT_TRUE(fs::exists(root_ / "report" / "report.html"));
}

TEST_F(ReportTest, PosedCaptureIsCompleteWithoutSfmAndIgnoresAnOldOne) {
  MakeAll();
  MakeIngest(/*posed=*/true);
  const Json summary = WriteAndReadSummary();
  EXPECT_EQ(summary["status"], "complete");
  EXPECT_EQ(summary["split"]["registered"], 10);
  EXPECT_EQ(summary["stages"].size(), 5);
  EXPECT_EQ(RequireArtifact(root_ / "report", "report").inputs.size(), 5);
}

TEST_F(ReportTest, DamagedFilesAreShownNotThrown) {
  MakeAll();
  WriteFileAtomically(root_ / "pose" / "points.ply", "ply\nelement vertex 1000000000000\nend_header\n");
  EXPECT_TRUE(WarningKinds(WriteAndReadSummary()).contains("damaged files"));
  WriteFileAtomically(root_ / "pose" / "scene.json", "{");
  fs::remove(root_ / "eval" / "metrics.json");
  fs::remove(root_ / "render" / "depth" / "0.png");
  EXPECT_TRUE(WarningKinds(WriteAndReadSummary()).contains("damaged files"));
  WriteFileAtomically(root_ / "train" / "manifest.json", "{\"schema_version\": 1}");
  const Json summary = WriteAndReadSummary();
  EXPECT_EQ(summary["failure"]["stage"], "train");
}

TEST_F(ReportTest, StabilityIsShownWhereItWasMeasured) {
  MakeAll();
  WriteReport(root_);
  EXPECT_TRUE(PageData(root_ / "report" / "report.html")["stability"].is_null());
  fs::create_directories(root_ / "stability");
  const Json table = {{"schema_version", 1}, {"n_exceeded", 0}, {"cases", {{{"part", "compositing"}}}}};
  WriteJson(root_ / "stability" / "stability.json", table);
  WriteReport(root_);
  EXPECT_EQ(PageData(root_ / "report" / "report.html")["stability"], table);
  for (const char* damaged : {"{", "[]", "{\"schema_version\": 1, \"cases\": 3, \"n_exceeded\": 0}"}) {
    WriteFileAtomically(root_ / "stability" / "stability.json", damaged);
    EXPECT_TRUE(WarningKinds(WriteAndReadSummary()).contains("damaged files")) << damaged;
    EXPECT_TRUE(PageData(root_ / "report" / "report.html")["stability"].is_null());
  }
}

TEST_F(ReportTest, JointReportHasARowForEveryCaptureAlsoForOneThatFailed) {
  MakeAll();
  WriteReport(root_);
  const fs::path failed = folder_ / "hall %way";
  Workspace(failed).WriteMarker({"/photos/hall", {}});
  Workspace(failed).Record("ingest", {false, 3, "No photo can be read."});
  WriteJointReport(folder_, {root_, failed});
  const Json summary = ReadJson(folder_ / "report" / "summary.json");
  ASSERT_EQ(summary["captures"].size(), 2);
  const Json &first = summary["captures"][0], &second = summary["captures"][1];
  EXPECT_EQ(first["name"], "fox");
  EXPECT_EQ(first["metrics"]["psnr"], 20.5);
  EXPECT_TRUE(fs::exists(folder_ / std::string(first["report"])));
  EXPECT_EQ(second["workspace"], "hall %25way");
  EXPECT_EQ(second["status"], "failed");
  EXPECT_EQ(second["failure"]["stage"], "ingest");
  EXPECT_EQ(second["failure"]["error"], "No photo can be read.");
  EXPECT_TRUE(second["report"].is_null());
  const Json page = PageData(folder_ / "report" / "report.html");
  EXPECT_EQ(page["captures"][0]["picture"], "data:image/png;base64,Qg==");
  EXPECT_EQ(page["captures"][0]["curve"].size(), 2);
  EXPECT_TRUE(page["comparisons"].empty());
}

TEST_F(ReportTest, RunsOfOneCaptureAreShownSideBySide) {
  MakeAll();
  const fs::path first = root_;
  root_ = folder_ / "again";
  Workspace(root_).WriteMarker({"/photos/fox", {{"budget", "60s"}}});
  MakeAll();
  const fs::path other = folder_ / "other";
  Workspace(other).WriteMarker({"/photos/hall", {}});
  WriteJointReport(folder_, {other, first, root_});
  const Json comparisons = PageData(folder_ / "report" / "report.html")["comparisons"];
  ASSERT_EQ(comparisons.size(), 1);
  EXPECT_EQ(comparisons[0]["runs"], Json({1, 2}));
  ASSERT_EQ(comparisons[0]["views"].size(), 2);
  const Json& worst = comparisons[0]["views"][0];
  EXPECT_EQ(worst["name"], Name(0));
  EXPECT_EQ(worst["truth"], "data:image/png;base64,QQ==");
  ASSERT_EQ(worst["shown"].size(), 2);
  EXPECT_EQ(worst["shown"][1]["psnr"], 20);
  EXPECT_EQ(worst["shown"][1]["error"], "data:image/png;base64,QQ==");
}

// The first of the usual Chromium-like browsers on PATH; empty: there is none.
fs::path Browser() {
  const char* path = std::getenv("PATH");
  std::istringstream folders(path == nullptr ? "" : path);
  for (std::string folder; std::getline(folders, folder, ':');) {
    for (const char* name : {"chromium", "chromium-browser", "google-chrome"}) {
      if (fs::exists(fs::path(folder) / name)) return fs::path(folder) / name;
    }
  }
  return {};
}

// Every kind of page runs its script to the end in a real browser and complains of nothing; the benchmarks' pages with
// the results that the project publishes.
TEST_F(ReportTest, PagesRunInABrowserWithoutAWord) {
  const fs::path browser = Browser();
  if (browser.empty()) GTEST_SKIP() << "no chromium on PATH";
  const fs::path results = fs::path(NRFF_SOURCE_DIR) / "tests/bench/results";
  MakeAll();
  fs::create_directories(root_ / "stability");
  fs::copy_file(results / "stability.json", root_ / "stability" / "stability.json");
  WriteReport(root_);
  const fs::path first = root_;
  root_ = folder_ / "again";
  Workspace(root_).WriteMarker({"/photos/fox", {}});
  MakeAll();
  WriteJointReport(folder_, {first, root_});
  std::map<fs::path, std::string> pages = {{first / "report" / "report.html", kAwkwardName},
                                           {folder_ / "report" / "report.html", "side by side"}};
  for (const auto& [json, page] : {std::pair("ablation_lego_nsvf_400", "ablation.html"),
                                   {"work_precision_fox", "work_precision.html"},
                                   {"benchmark_tanks-and-temples", "benchmark.html"},
                                   {"stability", "stability.html"}}) {
    const fs::path file = folder_ / page;
    const Json data = ReadJson(results / (std::string(json) + ".json"));
    WriteFileAtomically(file, FillPage(page, json, data));
    pages[file] = data.at("host").at("cpu").get<std::string>();
  }
  for (const auto& [page, shown] : pages) {
    // A profile of its own, and no sandbox, which root and containers do not have.
    const ProgramResult result =
        RunProgram({browser.string(), "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr",
                    "--user-data-dir=" + (folder_ / "profile").string(), "--virtual-time-budget=3000", "--dump-dom",
                    "file://" + page.string()});
    EXPECT_EQ(result.exit_code, 0) << page;
    std::istringstream log(result.err);
    for (std::string line; std::getline(log, line);) {
      EXPECT_EQ(line.find(":CONSOLE:"), std::string::npos) << page << ": " << line;
    }
    const size_t drawn = result.out.find("<main"), end = result.out.find("</main>");
    ASSERT_NE(drawn, std::string::npos) << page;
    std::string text = EscapeHtml(shown);
    EXPECT_NE(result.out.substr(drawn, end - drawn).find(text.substr(0, text.find('&'))), std::string::npos) << page;
  }
}

}  // namespace
}  // namespace nrff
