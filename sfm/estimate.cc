#include "sfm/estimate.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/log.h"
#include "sfm/capture.h"
#include "sfm/colmap_model.h"
#include "sfm/colmap_runner.h"
#include "sfm/gps.h"
#include "sfm/reconstruct.h"
#include "sfm/sfm_diagnosis.h"
#include "sfm/source.h"
#include "sfm/working_photos.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

// Photos up to which the thorough settings are affordable at once: they have 153 pairs, about half a second each.
constexpr int kAffordableImages = 18;
constexpr int kNearest = 5;  // by GPS

// In the order in which they are tried. Features are found at the photo's own scale by kFast only; the others start one
// octave up, which takes four times as long and gives about three times as many.
SfmSettings Settings(int level, bool exhaustive, uint64_t seed, int n_threads) {
  SfmSettings settings;
  settings.exhaustive = exhaustive;
  settings.seed = seed;
  settings.n_threads = n_threads;
  switch (level) {
    case 0:
      settings.name = "fast";
      break;
    case 1:
      settings.name = "thorough";
      settings.max_image_size = 1600;
      settings.max_features = 4096;
      settings.first_octave = -1;
      settings.n_neighbours = 15;
      break;
    default:
      settings.name = "exhaustive";
      settings.max_image_size = 2400;
      settings.max_features = 8192;
      settings.first_octave = -1;
      settings.n_neighbours = 20;
      settings.peak_threshold = 0.004;
      settings.tolerant_mapping = true;
      break;
  }
  return settings;
}

size_t NumRegistered(const Attempt& attempt) {
  const ColmapModel* largest = LargestModel(attempt.models);
  return largest ? largest->images.size() : 0;
}

Json AttemptFacts(const Attempt& attempt) {
  const SfmSettings& s = attempt.settings;
  return {{"settings", s.name},
          {"max_image_size", s.max_image_size},
          {"max_features", s.max_features},
          {"peak_threshold", s.peak_threshold},
          {"matching", s.exhaustive ? "exhaustive" : "selective"},
          {"n_pairs", attempt.n_pairs},
          {"n_registered", NumRegistered(attempt)},
          {"seconds", attempt.seconds_features + attempt.seconds_matching + attempt.seconds_mapping}};
}

// The model as the rest of the pipeline wants it: images named by id, cameras of the photos' own size.
ColmapModel AtFullSize(const ColmapModel& working, const Capture& capture, double& reprojection_error_px) {
  std::map<std::string, const CaptureImage*> by_id;
  for (const CaptureImage& photo : capture.images) by_id[photo.id] = &photo;
  ColmapModel model = working;
  std::map<uint32_t, double> scale_by_image;  // photo px per working px
  for (auto& [id, image] : model.images) {
    image.name = IdOfWorkingPhoto(image.name);
    const auto photo = by_id.find(image.name);
    if (photo == by_id.end())
      throw CorruptError("COLMAP's model holds an image " + image.name +
                         " that is not of this capture; remove the partial artifact and run again");
    const ColmapCamera& camera = working.cameras.at(image.camera_id);
    const ImageInfo& info = photo->second->info;
    model.cameras[image.camera_id] = ScaledCamera(camera, info.width, info.height);
    const double scale_x = double(info.width) / camera.width, scale_y = double(info.height) / camera.height;
    scale_by_image[id] = (scale_x + scale_y) / 2;
    for (ColmapObservation& observation : image.observations) {
      observation.x *= scale_x;
      observation.y *= scale_y;
    }
  }
  std::erase_if(model.cameras, [&](const auto& camera) {
    return std::none_of(model.images.begin(), model.images.end(),
                        [&](const auto& image) { return image.second.camera_id == camera.first; });
  });
  double sum = 0;
  for (auto& [id, point] : model.points) {
    if (!point.track.empty()) point.error_px *= scale_by_image.at(point.track.front().first);
    sum += point.error_px;
  }
  reprojection_error_px = model.points.empty() ? 0 : sum / double(model.points.size());
  return model;
}

void RecordFacts(const std::vector<Attempt>& attempts, const Attempt& best, const Capture& capture,
                 const ColmapModel& model, double reprojection_error_px, Json& facts) {
  std::vector<std::string> unregistered;
  size_t n_registered_train = 0;
  for (const CaptureImage& photo : capture.images) {
    const bool registered = std::any_of(model.images.begin(), model.images.end(),
                                        [&](const auto& image) { return image.second.name == photo.id; });
    if (!registered) unregistered.push_back(photo.Name());
    n_registered_train += registered && photo.split == Split::kTrain;
  }
  facts["n_images"] = capture.images.size();
  facts["n_registered"] = model.images.size();
  facts["n_registered_train"] = n_registered_train;
  facts["n_registered_test"] = model.images.size() - n_registered_train;
  facts["unregistered"] = unregistered;
  facts["n_points"] = model.points.size();
  facts["reprojection_error_px"] = reprojection_error_px;
  facts["matching"] = best.settings.exhaustive ? "exhaustive" : "selective";
  facts["n_models"] = best.models.size();
  facts["models"] = Json::array();
  for (const ColmapModel& m : best.models) {
    facts["models"].push_back({{"n_images", m.images.size()}, {"n_points", m.points.size()}});
  }
  facts["attempts"] = Json::array();
  double features = 0, matching = 0, mapping = 0;
  for (const Attempt& attempt : attempts) {
    facts["attempts"].push_back(AttemptFacts(attempt));
    features += attempt.seconds_features;
    matching += attempt.seconds_matching;
    mapping += attempt.seconds_mapping;
  }
  facts["seconds_features"] = features;
  facts["seconds_matching"] = matching;
  facts["seconds_mapping"] = mapping;
}

}  // namespace

void EstimatePoses(const fs::path& ingest_dir, const EstimateOptions& options, ArtifactWriter& artifact) {
  const Capture capture = LoadCapture(ingest_dir);
  const int n_images = int(capture.images.size());
  Colmap colmap(artifact.dir() / "colmap.log", options.stall_limit_seconds);
  artifact.facts()["colmap_version"] = colmap.version();

  Decision matching = needs::ExhaustiveMatching(n_images, capture.ordered);
  Force(matching, options.exhaustive);
  artifact.AddDecision(matching);
  bool gps_pairs = false;
  if (!matching.needed) {
    const std::vector<GpsPosition> positions = GpsPositions(capture);
    const Decision gps =
        needs::GpsPairs(positions.empty() ? std::nullopt : std::optional(Spread_m(LocalPositions(positions))));
    gps_pairs = gps.needed;
    artifact.AddDecision(gps);
  }

  const int first_level = n_images <= kAffordableImages ? 1 : 0;
  const fs::path work = artifact.dir() / "work";
  std::vector<Attempt> attempts;
  size_t best = 0;
  const bool given = options.max_image_size || options.max_features;
  for (const int level : {given ? 0 : first_level, first_level + 1}) {
    SfmSettings settings = Settings(level, matching.needed, options.seed, options.n_threads);
    if (gps_pairs) settings.n_nearest = kNearest;
    if (given) {
      settings.name = "given";
      settings.max_image_size = options.max_image_size.value_or(settings.max_image_size);
      settings.max_features = options.max_features.value_or(settings.max_features);
    }
    attempts.push_back(Reconstruct(capture, settings, colmap, work / settings.name, artifact));
    if (NumRegistered(attempts.back()) > NumRegistered(attempts[best])) best = attempts.size() - 1;
    const size_t n_registered = NumRegistered(attempts[best]);
    LogInfo(std::to_string(n_registered) + " of " + std::to_string(n_images) + " photos registered");
    if (given || double(n_registered) >= kEnough * n_images) break;
    if (level == first_level) LogWarning("too few: trying again with larger photos and more features");
  }

  const ColmapModel* largest = LargestModel(attempts[best].models);
  const size_t n_registered = NumRegistered(attempts[best]);
  if (n_registered < size_t(kFewestImages) || double(n_registered) < kFewest * n_images) {
    throw InputError(DiagnoseRegistration(capture, attempts.back().database, largest));
  }
  double reprojection_error_px = 0;
  const ColmapModel model = AtFullSize(*largest, capture, reprojection_error_px);
  fs::create_directories(artifact.dir() / kGivenModelDir);
  WriteColmapBinary(model, artifact.dir() / kGivenModelDir);
  RecordFacts(attempts, attempts[best], capture, model, reprojection_error_px, artifact.facts());
  fs::remove_all(work);
  artifact.AddOutput(kGivenModelDir);
}

}  // namespace nrff
