#include "sfm/estimate.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/log.h"
#include "sfm/base_mapping.h"
#include "sfm/bundle_refinement.h"
#include "sfm/capture.h"
#include "sfm/colmap_model.h"
#include "sfm/colmap_runner.h"
#include "sfm/gps.h"
#include "sfm/lens_attempts.h"
#include "sfm/pieces.h"
#include "sfm/reconstruct.h"
#include "sfm/sensor_frame.h"
#include "sfm/sfm_diagnosis.h"
#include "sfm/source.h"
#include "sfm/working_photos.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

// Photos up to which the thorough settings are affordable at once: they have 153 pairs, about half a second each.
constexpr int kAffordableImages = 18;
constexpr int kNearest = 5;  // by GPS
constexpr char kPieceLists[] = "groups", kWorkDir[] = "work";

// In the order in which they are tried. Features are found at the photo's own scale by kFast only; the others start one
// octave up, which takes four times as long and gives about three times as many.
SfmSettings Settings(int level) {
  SfmSettings settings;
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

Json LensTrials(const LensChoice& choice) {
  Json trials = Json::array();
  for (const LensTrial& trial : choice.trials)
    trials.push_back({{"camera_model", CameraModelName(trial.model)}, {"error_px", trial.error_px}});
  return trials;
}

Json AttemptFacts(const Attempt& attempt) {
  const SfmSettings& s = attempt.settings;
  return {{"settings", s.name},
          {"extended", attempt.grown.has_value()},
          {"max_image_size", s.max_image_size},
          {"max_features", s.max_features},
          {"peak_threshold", s.peak_threshold},
          {"matching", s.exhaustive ? "exhaustive" : "selective"},
          {"n_pairs", attempt.n_pairs},
          {"n_registered", NumRegistered(attempt)},
          {"seconds", attempt.seconds_features + attempt.seconds_matching + attempt.seconds_mapping}};
}

// The model as the rest of the pipeline wants it: images named by id, cameras of the photos' own size, turned as they
// are displayed.
ColmapModel AtFullSize(const ColmapModel& working, const Capture& capture, double& reprojection_error_px) {
  std::map<std::string, const CaptureImage*> by_id;
  for (const CaptureImage& photo : capture.images) by_id[photo.id] = &photo;
  ColmapModel model = working;
  std::map<uint32_t, double> scale_by_image;                    // photo px per working px
  std::map<std::pair<uint32_t, int>, uint32_t> turned_cameras;  // by camera and quarter turns
  for (auto& [id, image] : model.images) {
    image.name = IdOfWorkingPhoto(image.name);
    const auto photo = by_id.find(image.name);
    if (photo == by_id.end())
      throw CorruptError("COLMAP's model holds an image " + image.name +
                         " that is not of this capture; remove the partial artifact and run again");
    const ColmapCamera& camera = working.cameras.at(image.camera_id);
    const auto [width, height] = SensorSize(photo->second->info);
    const int turns = QuarterTurns(photo->second->info.orientation);
    if (turns > 0) {
      const uint32_t next_id = model.cameras.rbegin()->first + 1;
      image.camera_id = turned_cameras.emplace(std::pair(camera.id, turns), next_id).first->second;
    }
    ColmapCamera full_size = TurnedCamera(ScaledCamera(camera, width, height), turns);
    full_size.id = image.camera_id;
    model.cameras[image.camera_id] = std::move(full_size);
    const double scale_x = double(width) / camera.width, scale_y = double(height) / camera.height;
    scale_by_image[id] = (scale_x + scale_y) / 2;
    for (ColmapObservation& observation : image.observations) {
      observation.x *= scale_x;
      observation.y *= scale_y;
    }
    TurnImage(image, width, height, turns);
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
  double widest_deg = 0;
  std::set<std::string> camera_models;
  for (const auto& [id, camera] : model.cameras) {
    widest_deg = std::max(widest_deg, FieldOfView_deg(camera));
    camera_models.insert(CameraModelName(camera.model));
  }
  facts["camera_models"] = camera_models;
  facts["field_of_view_deg"] = widest_deg;
  facts["matching"] = best.settings.exhaustive ? "exhaustive" : "selective";
  facts["models"] = Json::array();
  const auto add_model = [&](const ColmapModel& m) {
    facts["models"].push_back({{"n_images", m.images.size()}, {"n_points", m.points.size()}});
  };
  if (best.grown && BestModel(best) == &*best.grown) {
    add_model(*best.grown);
  } else {
    for (const ColmapModel& m : best.models) add_model(m);
  }
  facts["n_models"] = facts["models"].size();
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

// The options that decide which features and lenses there are.
Json Asked(const EstimateOptions& options) {
  const auto or_null = [](const auto& value) { return value ? Json(*value) : Json(); };
  return {{"photos", "as their sensor had them"},
          {"max_image_size", or_null(options.max_image_size)},
          {"max_features", or_null(options.max_features)},
          {"camera_model", options.camera_model ? Json(CameraModelName(*options.camera_model)) : Json()}};
}

// How well the photos fix the model, for people and the report; no payload, as it holds times.
void Certify(const ColmapModel& model, int n_threads, ArtifactWriter& artifact) {
  if (model.images.size() > kMostImagesForCovariance) {
    LogInfo("how well the photos fix the poses is not measured beyond " + std::to_string(kMostImagesForCovariance));
    return;
  }
  const BundleCertificate certificate = RefineBundle(model, {.n_threads = n_threads}).certificate;
  const Json json = CertificateJson(certificate, model);
  WriteJson(artifact.dir() / kRefinementName, json);
  if (certificate.degeneracy) LogWarning(*certificate.degeneracy);
  artifact.facts()["certificate"] = {{"seconds", certificate.seconds},
                                     {"converged", certificate.converged},
                                     {"degeneracy", json.at("degeneracy")},
                                     {"structure", certificate.structure},
                                     {"median_error_px", json.at("reprojection_error_px").at("before").at("median")}};
}

// With a focal length for each image where photos need it.
ColmapModel WithFocalLengths(const ColmapModel& mapped, const EstimateOptions& options, ArtifactWriter& artifact) {
  const std::optional<FocalLengthTrial> trial = TryOwnFocalLengths(mapped, options.n_threads);
  if (!trial) return mapped;
  Decision own = needs::OwnFocalLengths(trial->shared_px, trial->own_px);
  Force(own, options.own_focal_lengths);
  artifact.AddDecision(own);
  if (!own.needed) return mapped;
  LogInfo("a focal length for each photo: " + own.evidence);
  return WithOwnFocalLengths(mapped, options.n_threads);
}

struct Outcome {
  std::vector<Attempt> attempts;
  size_t best = 0;
  Pieces pieces;      // of the best attempt
  LensChoice lenses;  // of the last that there was enough to judge by; none of fisheyes
};

// Goes on from the base, then from fast settings to thorough ones until enough photos are placed.
Outcome MakeAttempts(const Capture& capture, const EstimateOptions& options, bool exhaustive, bool gps_pairs,
                     const std::optional<BaseMapping>& base, Colmap& colmap, ArtifactWriter& artifact) {
  const int n_images = int(capture.images.size());
  const int first_level = n_images <= kAffordableImages ? 1 : 0;
  const fs::path work = artifact.dir() / kWorkDir;
  Outcome outcome;
  std::vector<Attempt>& attempts = outcome.attempts;
  size_t& best = outcome.best;
  LensChoice& lenses = outcome.lenses;
  const auto take = [&](Attempt attempt) {
    attempts.push_back(std::move(attempt));
    if (NumRegistered(attempts.back()) > NumRegistered(attempts[best])) best = attempts.size() - 1;
    LogInfo(std::to_string(NumRegistered(attempts.back())) + " of " + std::to_string(n_images) + " photos registered");
  };
  const bool given = options.max_image_size || options.max_features;
  const auto adapt = [&](SfmSettings& settings) {
    settings.exhaustive = exhaustive;
    settings.seed = options.seed;
    settings.n_threads = options.n_threads;
    if (gps_pairs) settings.n_nearest = kNearest;
  };
  if (base) {
    SfmSettings settings = base->settings;
    adapt(settings);
    attempts.push_back(Extend(*base, settings, capture, colmap, work, artifact));
    LogInfo(std::to_string(NumRegistered(attempts.back())) + " of " + std::to_string(n_images) +
            " photos registered, " + std::to_string(base->model.images.size()) + " of them were");
  }
  const bool extended = base && double(NumRegistered(attempts.back())) >= needs::kEnoughPlaced * n_images;
  if (base && !extended) LogWarning("too few: estimating all poses anew");
  for (const int level : {given ? 0 : first_level, first_level + 1}) {
    if (extended) break;
    SfmSettings settings = Settings(level);
    adapt(settings);
    if (given) {
      settings.name = "given";
      settings.max_image_size = options.max_image_size.value_or(settings.max_image_size);
      settings.max_features = options.max_features.value_or(settings.max_features);
    }
    if (options.camera_model) settings.camera_model = *options.camera_model;
    if (!attempts.empty()) settings.lenses = attempts[best].settings.lenses;
    const fs::path dir = work / settings.name;
    take(Reconstruct(capture, settings, colmap, dir, artifact));
    if (!options.camera_model && settings.lenses.empty()) {
      // Of as many photos the attempt is the better one whose lenses are true.
      const auto take_lenses = [&](Attempt attempt) {
        take(std::move(attempt));
        if (NumRegistered(attempts.back()) == NumRegistered(attempts[best])) best = attempts.size() - 1;
      };
      const ColmapModel* largest = LargestModel(attempts.back().models);
      LensChoice choice = largest ? ChooseLens(*largest, options.n_threads) : LensChoice();
      const bool simple_fits = !choice.trials.empty() && choice.chosen == CameraModel::kSimpleRadial;
      if (auto fisheye = AsFisheye(capture, attempts.back(), simple_fits, colmap, dir, artifact)) {
        take_lenses(std::move(*fisheye));
        lenses = {};
      } else if (!choice.trials.empty()) {
        lenses = std::move(choice);
        if (!simple_fits) {
          LogInfo("lenses of the model " + std::string(CameraModelName(lenses.chosen)) + ": " +
                  lenses.decision->evidence);
          take_lenses(WithRicherLenses(capture, attempts.back(), lenses, colmap, dir, artifact));
        }
      }
    }
    const Pieces& pieces = outcome.pieces = FindPieces(capture, attempts[best].database, attempts[best].models);
    if (given || level > first_level) break;
    Decision again = needs::SecondAttempt(n_images, int(NumRegistered(attempts[best])), int(pieces.pieces.size()),
                                          pieces.NumPlaced(), pieces.n_holding);
    Force(again, options.second_attempt);
    artifact.AddDecision(again);
    if (!again.needed) break;
    LogWarning("too few: trying again with larger photos and more features");
  }
  return outcome;
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
    Decision gps =
        needs::GpsPairs(positions.empty() ? std::nullopt : std::optional(Spread_m(LocalPositions(positions))));
    if (options.gps_pairs == true && positions.empty())
      throw InputError(
          "pairs by GPS were asked for, but not every photo says where it was taken; leave --gps-pairs on out");
    Force(gps, options.gps_pairs);
    gps_pairs = gps.needed;
    artifact.AddDecision(gps);
  }

  const std::optional<BaseMapping> base =
      options.base.empty() ? std::nullopt : ReadBaseMapping(options.base, Asked(options));
  const Outcome outcome = MakeAttempts(capture, options, matching.needed, gps_pairs, base, colmap, artifact);
  const auto& [attempts, best, pieces, lenses] = outcome;
  if (lenses.decision) artifact.AddDecision(*lenses.decision);
  fs::remove_all(artifact.dir() / kPieceLists);
  std::string groups, advice;
  if (pieces.pieces.size() > 1) {
    WritePieceLists(capture, pieces, artifact.dir() / kPieceLists);
    groups = DescribePieces(capture, pieces);
    advice = AdviseOnPieces(capture, pieces, fs::path("sfm") / kPieceLists);
  }

  const ColmapModel* largest = BestModel(attempts[best]);
  const size_t n_registered = NumRegistered(attempts[best]);
  if (n_registered < size_t(kFewestImages) || double(n_registered) < kFewest * n_images) {
    if (groups.empty()) throw InputError(DiagnoseRegistration(capture, attempts.back().database, largest));
    throw InputError("only " + std::to_string(n_registered) + " of " + std::to_string(n_images) +
                     " photos could be placed together: " + groups + ". " +
                     AdviseOnPieces(capture, pieces, artifact.dir() / kPieceLists));
  }
  Decision refinement = needs::Refinement(largest->images.size(), kMostImagesForCovariance);
  Force(refinement, options.refine);
  artifact.AddDecision(refinement);
  const BundleOptions refine{.principal_points = !attempts[best].settings.lenses.empty(),
                             .n_threads = options.n_threads};
  const ColmapModel found = refinement.needed ? RefineBundle(*largest, refine).model : *largest;
  const ColmapModel mapped = base ? InBasesWorld(*base, capture, attempts[best], found, artifact) : found;
  const ColmapModel working = WithFocalLengths(mapped, options, artifact);
  double reprojection_error_px = 0;
  const ColmapModel model = AtFullSize(working, capture, reprojection_error_px);
  fs::create_directories(artifact.dir() / kGivenModelDir);
  WriteColmapBinary(model, artifact.dir() / kGivenModelDir);
  RecordFacts(attempts, attempts[best], capture, model, reprojection_error_px, artifact.facts());
  artifact.facts()["lens_trials"] = LensTrials(lenses);
  if (!groups.empty()) {
    artifact.facts()["groups"] = PiecesJson(capture, pieces);
    artifact.facts()["groups_advice"] = advice;
    LogWarning(groups + ". Going on with the largest. " + advice);
  }
  Certify(model, options.n_threads, artifact);
  KeepMapping(attempts[best], mapped, Asked(options), artifact.dir() / kMappingDir);
  fs::remove_all(artifact.dir() / kWorkDir);
  artifact.AddOutput(kGivenModelDir);
}

}  // namespace nrff
