// The whole pipeline with the real executables: a small posed capture, and photos that COLMAP has to pose.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>

#include "model/kernels/tile_gemm_bf16.h"
#include "pipeline/files.h"
#include "pipeline/manifest.h"
#include "tests/program.h"
#include "tests/temporary_directory.h"
#include "tests/test_photos.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;
using testing::ElementsAre;

struct Frame {
  Eigen::Vector3d centre;
  Eigen::Matrix3d rotation;  // world_from_camera
};

// By the photo's name without extension.
std::map<std::string, Frame> ReadFrames(const fs::path& transforms) {
  std::map<std::string, Frame> frames;
  const Json json = ReadJson(transforms);
  for (const Json& frame : json.at("frames")) {
    Frame& read = frames[fs::path(frame.at("file_path").get<std::string>()).stem()];
    for (int row = 0; row < 3; ++row) {
      for (int column = 0; column < 3; ++column) read.rotation(row, column) = frame["transform_matrix"][row][column];
      read.centre[row] = frame["transform_matrix"][row][3];
    }
  }
  return frames;
}

class Pipeline : public testing::Test {
 protected:
  ProgramResult Nrff(std::vector<std::string> arguments) const {
    arguments.insert(arguments.begin(), "nrff");
    ProgramResult result = RunProgram(arguments);
    EXPECT_EQ(result.exit_code, 0) << result.err;
    return result;
  }
  Json NrffJson(std::vector<std::string> arguments) const {
    arguments.emplace_back("--json");
    return Json::parse(Nrff(std::move(arguments)).out);
  }
  Json Summary() const { return ReadJson(workspace_ / "report" / "summary.json"); }

  TemporaryDirectory temporary_;
  fs::path capture_ = temporary_.path() / "capture", workspace_ = temporary_.path() / "work";
};

// stage → state of the only capture in `nrff run --json` or the only workspace in `nrff status --json`.
std::map<std::string, std::string> States(const Json& capture) {
  std::map<std::string, std::string> states;
  for (const Json& stage : capture.at("stages")) states[stage.at("stage")] = stage.at("state");
  return states;
}

class PosedPipeline : public Pipeline {
 protected:
  void SetUp() override {
    MakeExampleCapture(capture_, {"--posed", "--views", "17", "--width", "64", "--height", "48"});
  }
  // A few steps are enough to see what runs.
  std::vector<std::string> Run(const std::vector<std::string>& more = {"--steps", "15"}) const {
    std::vector<std::string> arguments = {"run", capture_, "-w", workspace_, "--preset", "tiny"};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return arguments;
  }
};

TEST_F(PosedPipeline, ScoresHeldOutViewsAndReportsAllOfIt) {
  Nrff(Run({"--steps", "200"}));
  const Json summary = Summary();
  EXPECT_EQ(summary.at("status"), "complete");
  EXPECT_GT(summary.at("metrics").at("psnr"), 14);
  EXPECT_LT(summary.at("metrics").at("psnr"), 45);
  EXPECT_GT(summary.at("metrics").at("ssim"), 0.1);
  EXPECT_LE(summary.at("metrics").at("ssim"), 1);
  EXPECT_TRUE(summary.at("metrics").at("lpips").is_null());

  EXPECT_EQ(summary.at("split").at("train"), 14);
  EXPECT_EQ(summary.at("split").at("test"), 3);
  EXPECT_EQ(summary.at("split").at("registered"), 17);
  ASSERT_EQ(summary.at("images").size(), 3u);
  double sum = 0;
  for (const Json& image : summary.at("images")) {
    sum += image.at("psnr").get<double>();
    EXPECT_TRUE(fs::is_regular_file(workspace_ / image.at("rendered").get<std::string>()));
    EXPECT_TRUE(fs::is_regular_file(workspace_ / image.at("truth").get<std::string>()));
  }
  EXPECT_EQ(summary.at("images")[0].at("name"), "IMG_0001.png");
  EXPECT_NEAR(sum / 3, summary.at("metrics").at("psnr"), 1e-9);

  std::vector<std::string> stages;
  for (const Json& stage : summary.at("stages")) {
    stages.push_back(stage.at("name"));
    EXPECT_GT(stage.at("seconds"), 0);
    EXPECT_GT(stage.at("peak_memory_bytes"), 1e6);
    EXPECT_FALSE(stage.at("reused"));
  }
  EXPECT_THAT(stages, ElementsAre("ingest", "pose", "train", "render", "eval"));
  std::map<std::string, bool> needed;
  for (const Json& decision : summary.at("decisions")) {
    needed[decision.at("feature")] = decision.at("needed");
    for (const char* key : {"evidence", "threshold", "reason"}) EXPECT_TRUE(decision.at(key).is_string());
  }
  EXPECT_FALSE(needed.at("sfm"));
  EXPECT_FALSE(needed.at("undistortion"));
  EXPECT_EQ(summary.at("training").at("steps"), 200);
  EXPECT_GT(summary.at("training").at("samples"), 200);
  const Json &first = summary.at("training").at("curve").front(), &last = summary.at("training").at("curve").back();
  EXPECT_GT(last.at("psnr").get<double>(), first.at("psnr").get<double>() + 1) << "training did not get anywhere";
  for (const char* key : {"seconds", "steps", "samples", "psnr"}) EXPECT_TRUE(last.at(key).is_number()) << key;
  EXPECT_TRUE(summary.contains("settings") && summary.at("versions").contains("nrff"));
  EXPECT_GT(fs::file_size(workspace_ / "report" / "report.html"), 10'000u);
}

TEST_F(PosedPipeline, ErrorAgainstTimeIsMeasuredOnTheScenesOwnModelAndRenders) {
  Nrff(Run({"--steps", "100"}));
  const Json result = NrffJson({"benchmark", "work-precision", workspace_, "--parts", "training,rendering,scoring",
                                "--budgets", "2s", "--seeds", "1"});
  const Json& band = result.at("training").at("bands").at(0);
  EXPECT_GT(band.at("psnr").at("mean"), 10);
  EXPECT_EQ(band.at("presets").size(), 1);
  EXPECT_NEAR(band.at("seconds").at("mean").get<double>(), 2, 1);

  std::map<std::string, Json> families;
  for (const Json& family : result.at("rendering").at("families")) {
    families[family.at("family")] = family.at("points");
    const auto chosen = [](const Json& point) { return point.at("chosen").get<bool>(); };
    EXPECT_EQ(std::count_if(family.at("points").begin(), family.at("points").end(), chosen), 1) << family;
  }
  ASSERT_EQ(families.size(), 7u);
  for (const char* family : {"weight threshold", "early stop", "colour tolerance", "precision", "levels left out"}) {
    // From coarse to fine; with nothing left out there is no error.
    EXPECT_EQ(families[family].back().at("rmse"), 0) << family;
    if (std::string(family) == "precision" && AvailableBf16Unit() == Bf16Unit::kNone) {
      EXPECT_EQ(families[family].front().at("rmse"), 0) << "processors without bf16 products take float ones";
      continue;
    }
    EXPECT_GT(families[family].front().at("rmse"), families[family].back().at("rmse")) << family;
  }
  EXPECT_GT(families["step"].front().at("rmse"), families["step"].back().at("rmse"));
  EXPECT_GT(families["as nrff-render"].front().at("psnr"), 10);

  const Json& scoring = result.at("scoring").back();
  EXPECT_EQ(scoring.at("width"), 64);
  EXPECT_NEAR(scoring.at("psnr"), Summary().at("metrics").at("psnr"), 1e-9);
  EXPECT_NEAR(scoring.at("ssim"), Summary().at("metrics").at("ssim"), 1e-9);
  EXPECT_GT(fs::file_size(workspace_ / "work-precision/work_precision.html"), 10'000u);

  // The poses that people are given are those that the capture brought.
  const ProgramResult compared =
      RunProgram({"nrff-pose", "compare", "--estimated", workspace_.string(), "--truth", capture_.string(), "--json"});
  const Json errors = Json::parse(compared.out);
  EXPECT_EQ(errors.at("n_matched"), 17);
  EXPECT_LT(errors.at("position").at("max"), 1e-6);
}

TEST_F(PosedPipeline, SixteenBitsShowWhatEightRound) {
  Nrff(Run({"--steps", "30", "--bit-depth", "16"}));
  const Json metrics = ReadJson(workspace_ / "eval/metrics.json");
  EXPECT_EQ(metrics.at("protocol").at("bits").at("rendered"), 16);
  const double stored = metrics.at("metrics").at("psnr"),
               rounded = metrics.at("metrics").at("variants").at("psnr_quantised");
  EXPECT_NE(stored, rounded);
  EXPECT_NEAR(stored, rounded, 0.1);
}

TEST_F(PosedPipeline, RunsAgainOnlyWhatItMust) {
  Nrff(Run());
  const Json again = NrffJson(Run()).at("captures")[0];
  for (const auto& [stage, state] : States(again)) EXPECT_EQ(state, "reused") << stage;

  // Another file in the capture's folder: ingest runs again, finds the same, and what follows stays as it is.
  const std::string train = ReadManifest(workspace_ / "train")->ContentHash();
  WriteFileAtomically(capture_ / "notes.txt", "not part of the capture");
  auto states = States(NrffJson(Run()).at("captures")[0]);
  EXPECT_EQ(states.at("ingest"), "ran");
  for (const char* stage : {"pose", "train", "render", "eval"}) EXPECT_EQ(states.at(stage), "reused") << stage;
  EXPECT_EQ(ReadManifest(workspace_ / "train")->ContentHash(), train);

  states = States(NrffJson(Run({"--steps", "15", "--from", "render"})).at("captures")[0]);
  EXPECT_EQ(states.at("train"), "reused");
  EXPECT_EQ(states.at("render"), "ran");
}

TEST_F(PosedPipeline, UntilStopsAndStatusAndPlanSayWhatIsLeft) {
  const Json plan = NrffJson({"plan", capture_, "-w", workspace_});
  EXPECT_FALSE(fs::exists(workspace_)) << "plan wrote something";
  EXPECT_FALSE(plan.empty());

  Nrff(Run({"--steps", "15", "--until", "pose"}));
  EXPECT_TRUE(ReadManifest(workspace_ / "pose").has_value());
  EXPECT_FALSE(fs::exists(workspace_ / "train"));
  auto states = States(NrffJson({"status", workspace_}).at("workspaces")[0]);
  EXPECT_EQ(states.at("pose"), "done");
  EXPECT_EQ(states.at("train"), "missing");

  Nrff(Run());
  states = States(NrffJson({"status", workspace_}).at("workspaces")[0]);
  for (const auto& [stage, state] : states) EXPECT_EQ(state, "done") << stage;

  const fs::path frames = temporary_.path() / "orbit";
  Nrff({"render", workspace_, "--path", "orbit", "--frames", "5", "-o", frames});
  EXPECT_EQ(ListFiles(frames).size(), 5u);

  const ProgramResult scores = Nrff({"eval", workspace_});
  EXPECT_THAT(scores.out, testing::HasSubstr("IMG_0001.png"));
}

TEST_F(PosedPipeline, SeveralCapturesShareOneRunAndAJointReport) {
  const fs::path other = temporary_.path() / "other";
  MakeExampleCapture(other, {"--posed", "--views", "9", "--width", "48", "--height", "36", "--seed", "2"});
  const Json result = NrffJson({"run", capture_, other, "-w", workspace_, "--preset", "tiny", "--steps", "15"});
  ASSERT_EQ(result.at("captures").size(), 2u);
  for (const Json& capture : result.at("captures")) EXPECT_GT(capture.at("metrics").at("psnr"), 5);
  EXPECT_TRUE(fs::exists(workspace_ / "report" / "report.html"));
  EXPECT_TRUE(fs::exists(workspace_ / "other" / "report" / "summary.json"));
}

class PhotoPipeline : public Pipeline {
 protected:
  void SetUp() override {
    if (RunProgram({"/bin/sh", "-c", "command -v colmap"}).exit_code != 0) GTEST_SKIP() << "colmap is not installed";
  }
};

TEST_F(PhotoPipeline, ColmapFindsThePosesThatThePhotosWereTakenFrom) {
  MakeExampleCapture(capture_, {"--views", "12", "--width", "400", "--height", "300"});
  Nrff({"run", capture_ / "photos", "-w", workspace_, "--until", "pose"});
  const Json facts = ReadManifest(workspace_ / "sfm")->facts;
  EXPECT_EQ(facts.at("n_registered"), 12);
  EXPECT_LT(facts.at("reprojection_error_px"), 1);

  const auto truth = ReadFrames(capture_ / "truth" / "transforms.json");
  const auto found = ReadFrames(workspace_ / "pose" / "transforms.json");
  ASSERT_EQ(found.size(), truth.size());
  Eigen::Matrix3Xd truth_centres(3, truth.size()), found_centres(3, truth.size());
  Eigen::Index i = 0;
  for (const auto& [name, frame] : truth) {
    truth_centres.col(i) = frame.centre;
    found_centres.col(i++) = found.at(name).centre;
  }
  const Eigen::Matrix4d truth_from_found = Eigen::umeyama(found_centres, truth_centres);
  const double scale = truth_from_found.topLeftCorner<3, 3>().colwise().norm()[0];
  for (const auto& [name, frame] : truth) {
    const Eigen::Vector3d centre = (truth_from_found * found.at(name).centre.homogeneous()).head<3>();
    // The orbit's radius is 3.
    EXPECT_LT((centre - frame.centre).norm(), 0.03) << name;
    const Eigen::Matrix3d rotation = truth_from_found.topLeftCorner<3, 3>() / scale * found.at(name).rotation;
    EXPECT_LT(Eigen::AngleAxisd(rotation.transpose() * frame.rotation).angle(), 0.01) << name;
  }
}

TEST_F(PhotoPipeline, OddNamesLinkLoopsAndAReadOnlyFolderDoNotMatter) {
  MakeExampleCapture(capture_, {"--views", "12", "--width", "400", "--height", "300"});
  const fs::path photos = capture_ / "photos";
  const std::vector<std::string> names = {"a b.jpg", "c\nd.jpg", "e\"f'.jpg", "g\xff\xfe.jpg", "-h.jpg", "i%20.jpg"};
  for (size_t i = 0; i < names.size(); ++i) {
    fs::rename(photos / ("IMG_000" + std::to_string(i + 1) + ".jpg"), photos / names[i]);
  }
  fs::create_directory_symlink(".", photos / "again");
  fs::permissions(photos, fs::perms(0555));
  const std::string before = HashTree(photos);
  Nrff({"run", photos, "-w", workspace_, "--until", "pose"});
  EXPECT_EQ(ReadManifest(workspace_ / "sfm")->facts.at("n_registered"), 12);
  EXPECT_EQ(HashTree(photos), before);
  fs::permissions(photos, fs::perms(0755));
}

}  // namespace
}  // namespace nrff
