// nrff-pose estimate | normalise | compare | refine
#include <CLI/CLI.hpp>
#include <algorithm>
#include <filesystem>
#include <iostream>
#include <map>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/extension.h"
#include "pipeline/files.h"
#include "pipeline/manifest.h"
#include "pipeline/stage.h"
#include "sfm/bundle_refinement.h"
#include "sfm/capture.h"
#include "sfm/estimate.h"
#include "sfm/scene_pack.h"
#include "sfm/trajectory_errors.h"

namespace {

namespace fs = std::filesystem;

struct Common {
  fs::path ingest, out;
  int n_threads = std::max(1, int(std::thread::hardware_concurrency()));
};

void AddOutput(CLI::App& app, Common& common) {
  app.add_option("--out", common.out, "Artifact to write")->required();
  app.add_option("--threads", common.n_threads, "Threads to use")
      ->check(CLI::Range(1, nrff::kMostThreads))
      ->capture_default_str();
  nrff::AddVerbosity(app);
}

void AddCommon(CLI::App& app, Common& common) {
  app.add_option("--ingest", common.ingest, "Artifact of nrff-ingest")->required();
  AddOutput(app, common);
}

nrff::HashedPath Input(const fs::path& dir, const std::string& kind) {
  return nrff::ArtifactInput(dir, nrff::RequireArtifact(dir, kind));
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("Camera poses: estimated from the photos, then normalised and packed for training.", "nrff-pose");
  app.set_version_flag("--version", nrff::Version());
  app.require_subcommand(1);
  Common common;

  CLI::App* estimate = app.add_subcommand("estimate",
                                          "Estimates the poses with COLMAP.\nExample: nrff-pose estimate --ingest "
                                          "work/photos/ingest --out work/photos/sfm");
  AddCommon(*estimate, common);
  nrff::EstimateOptions estimation;
  estimate->add_option("--seed", estimation.seed, "Seed of COLMAP's random choices")
      ->capture_default_str()
      ->group(nrff::kParameterGroup);
  estimate
      ->add_option("--stall-limit", estimation.stall_limit_seconds,
                   "Seconds after which a silent, idle COLMAP is stopped")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  estimate->add_option("--base", estimation.base, "Artifact of fewer of the photos, to be extended");
  nrff::AddForcedOption(*estimate, "--matching", estimation.exhaustive, "exhaustive", "selective",
                        "Which pairs of photos are matched");

  estimate->add_option("--sfm-image-size", estimation.max_image_size, "Longer side of the photos for features, px")
      ->check(CLI::Range(nrff::kLeastMaxImageSize, nrff::kMostMaxImageSize))
      ->group(nrff::kParameterGroup);
  estimate->add_option("--sfm-features", estimation.max_features, "Features of a photo at the most")
      ->check(CLI::Range(16, 1000000))
      ->group(nrff::kParameterGroup);

  std::string camera_model = "auto";
  estimate
      ->add_option("--camera-model", camera_model,
                   "COLMAP's model of all lenses; auto: SIMPLE_RADIAL, or a richer one\nwhere the photos need it")
      ->check(CLI::IsMember(nrff::CameraModelChoices()))
      ->capture_default_str()
      ->group(nrff::kParameterGroup);
  nrff::AddForcedOption(*estimate, "--refinement", estimation.refine, "on", "off",
                        "Refine poses, lenses, points together at the end");
  nrff::AddForcedOption(*estimate, "--own-focal-lengths", estimation.own_focal_lengths, "on", "off",
                        "A focal length for each photo instead of shared ones");
  nrff::AddForcedOption(*estimate, "--gps-pairs", estimation.gps_pairs, "on", "off",
                        "Match photos taken near each other by GPS, too");
  nrff::AddForcedOption(*estimate, "--second-attempt", estimation.second_attempt, "on", "off",
                        "Try again with larger photos and more features");

  CLI::App* normalise = app.add_subcommand("normalise",
                                           "Normalises the poses, undistorts and packs the photos.\nExample: nrff-pose "
                                           "normalise --ingest work/photos/ingest --sfm"
                                           " work/photos/sfm --out work/photos/pose");
  AddCommon(*normalise, common);
  nrff::PoseOptions pose;
  fs::path sfm;
  normalise->add_option("--sfm", sfm, "Artifact of `nrff-pose estimate`; default: the poses that the capture brought");
  normalise->add_option("--max-image-size", pose.max_image_size, "Longer side of the packed photos, px")
      ->check(CLI::Range(nrff::kLeastMaxImageSize, nrff::kMostMaxImageSize))
      ->capture_default_str()
      ->group(nrff::kParameterGroup);
  normalise->add_option("--base", pose.base, "Artifact of fewer of the photos, whose frame is kept");
  nrff::AddForcedOption(*normalise, "--undistortion", pose.undistortion, "on", "off",
                        "Resample the photos to pinhole images");
  nrff::AddForcedOption(*normalise, "--contraction", pose.contraction, "on", "off",
                        "Contract what is outside the foreground box");

  CLI::App* compare = app.add_subcommand(
      "compare",
      "How far estimated poses are from true ones, after alignment by a robust\nsimilarity, and relative poses "
      "without. "
      "Both: a posed capture, a workspace, a\nCOLMAP model, a folder of 4×4 poses, or a Tanks & Temples .log file.\n"
      "Example: nrff-pose compare --estimated work/fox --truth fox");
  fs::path estimated, truth, transform, crop, aligned;
  bool as_json = false;
  compare->add_option("--estimated", estimated, "Estimated poses")->required();
  compare->add_option("--truth", truth, "True poses")->required();
  compare->add_option("--transform", transform, "Moves the true poses first: a 4×4 similarity (trans.txt)");
  compare->add_option(
      "--crop", crop,
      "Also by how much the object in this volume (SCENE.json, in the frame of\nthe moved true poses) is seen off");
  compare->add_option("--aligned", aligned, "Writes the estimated poses in the true frame as .log");
  compare->add_flag("--json", as_json, "The errors as JSON");
  nrff::AddVerbosity(*compare);

  CLI::App* refine = app.add_subcommand(
      "refine",
      "Refines the poses, lenses and points of a COLMAP model together, and says how\nwell the images fix them "
      "(refinement.json). A model that they do not fix comes\nback as it was.\n"
      "Example: nrff-pose refine --model work/fox/sfm --out work/refined");
  nrff::BundleOptions refinement;
  fs::path model;
  refine->add_option("--model", model, "A COLMAP model, or a folder with one in sparse/")->required();
  AddOutput(*refine, common);
  refine->add_option("--loss-scale", refinement.loss_scale_px, "Residuals beyond count less and less, px")
      ->check(CLI::PositiveNumber)
      ->capture_default_str()
      ->group(nrff::kParameterGroup);
  refine->add_option("--max-iterations", refinement.max_iterations, "Steps of a minimisation at the most")
      ->check(CLI::Range(1, 100000))
      ->capture_default_str()
      ->group(nrff::kParameterGroup);

  return nrff::StageMain(app, argc, argv, [&] {
    if (refine->parsed()) {
      refinement.n_threads = common.n_threads;
      model = nrff::FolderOfModel(model);
      nrff::ArtifactWriter artifact("refinement", common.out, nrff::GivenParams(*refine),
                                    {{nrff::EscapePath(model), nrff::HashTree(model), 0}});
      nrff::RefineModel(model, refinement, artifact);
      artifact.Commit();
      return;
    }
    if (compare->parsed()) {
      const nrff::Trajectory poses = nrff::ReadTrajectory(estimated);
      nrff::Trajectory true_poses = nrff::ReadTrajectory(truth);
      if (!transform.empty()) true_poses = nrff::Transformed(true_poses, nrff::ReadSimilarity(transform));
      std::optional<nrff::CropVolume> object;
      if (!crop.empty()) object = nrff::ReadCropVolume(crop);
      const nrff::Json errors = nrff::TrajectoryErrors(poses, true_poses, object ? &*object : nullptr);
      if (!aligned.empty()) {
        const auto values = errors.at("truth_from_estimated").get<std::vector<double>>();
        nrff::WriteTrajectoryLog(
            nrff::Transformed(poses, Eigen::Map<const Eigen::Matrix<double, 4, 4, Eigen::RowMajor>>(values.data())),
            aligned);
      }
      std::cout << (as_json ? errors.dump(1) + "\n" : nrff::TrajectoryErrorsText(errors));
      return;
    }
    if (estimate->parsed()) {
      estimation.n_threads = common.n_threads;
      if (camera_model != "auto") estimation.camera_model = nrff::CameraModelNamed(camera_model);
      std::vector<nrff::HashedPath> inputs = {Input(common.ingest, "ingest")};
      if (!estimation.base.empty()) inputs.push_back(nrff::BaseInput(estimation.base));
      nrff::ArtifactWriter artifact("sfm", common.out, nrff::GivenParams(*estimate), inputs,
                                    nrff::ArtifactWriter::kKeepPartial);
      nrff::EstimatePoses(common.ingest, estimation, artifact);
      artifact.Commit();
      return;
    }
    pose.n_threads = common.n_threads;
    std::vector<nrff::HashedPath> inputs = {Input(common.ingest, "ingest")};
    if (sfm.empty() && !nrff::LoadCapture(common.ingest).posed) {
      throw nrff::UsageError("the capture brings no poses: name the artifact of `nrff-pose estimate` with --sfm");
    }
    if (!sfm.empty()) inputs.push_back(Input(sfm, "sfm"));
    if (!pose.base.empty()) inputs.push_back(nrff::BaseInput(pose.base));
    nrff::ArtifactWriter artifact("pose", common.out, nrff::GivenParams(*normalise), inputs);
    nrff::WriteScene(common.ingest, (sfm.empty() ? common.ingest : sfm) / nrff::kGivenModelDir, pose, artifact);
    artifact.Commit();
  });
}
