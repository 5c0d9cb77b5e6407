#include "sfm/estimate.h"

#include <algorithm>
#include <cmath>
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
#include "sfm/final_model.h"
#include "sfm/full_size.h"
#include "sfm/gps.h"
#include "sfm/lens_attempts.h"
#include "sfm/merged_model.h"
#include "sfm/pieces.h"
#include "sfm/reconstruct.h"
#include "sfm/sfm_diagnosis.h"

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

void RecordFacts(const std::vector<Attempt>& attempts, const Attempt& best, const Capture& capture,
                 const ColmapModel& model, Json& facts) {
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
  facts["reprojection_error_px"] = MeanError(model);
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

// How well the photos fix the model, solved for with `options`, for people and the report; no payload, as it holds
// times.
void Certify(const ColmapModel& model, const BundleOptions& options, ArtifactWriter& artifact) {
  if (model.images.size() > kMostImagesForCovariance) {
    LogInfo("how well the photos fix the poses is not measured beyond " + std::to_string(kMostImagesForCovariance));
    return;
  }
  const BundleCertificate certificate = RefineBundle(model, options).certificate;
  const Json json = CertificateJson(certificate, model);
  WriteJson(artifact.dir() / kRefinementName, json);
  if (certificate.degeneracy) LogWarning(*certificate.degeneracy);
  artifact.facts()["certificate"] = {{"seconds", certificate.seconds},
                                     {"converged", certificate.converged},
                                     {"degeneracy", json.at("degeneracy")},
                                     {"structure", certificate.structure},
                                     {"median_error_px", json.at("reprojection_error_px").at("before").at("median")}};
}

// Of the photos' px per px of their working copies, over images.
double MeanScale(const ColmapModel& working, const ColmapModel& full_size) {
  double sum = 0;
  for (const auto& [id, image] : working.images) {
    sum += double(full_size.cameras.at(image.camera_id).width) / working.cameras.at(image.camera_id).width;
  }
  return sum / double(working.images.size());
}

// What minimises the same in photos so many times as large.
BundleOptions AtScale(BundleOptions options, double scale) {
  options.loss_scale_px *= scale;
  options.least_gain *= scale * scale;
  return options;
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
  if (extended && options.second_attempt == true)
    LogWarning("no second attempt: photos were added to earlier ones, whose settings stay; --force makes all anew");
  if (extended && (options.exhaustive == true || options.gps_pairs == true))
    LogWarning("pairs of the earlier photos stay as they were matched; --force matches all anew");
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
      LensChoice choice =
          largest ? ChooseLens(*largest, MayHaveOwnFocalLengths(largest->images.size(), options), options.n_threads)
                  : LensChoice();
      const bool simple_fits = !choice.trials.empty() && choice.chosen == CameraModel::kSimpleRadial && !choice.zoomed;
      if (auto fisheye = AsFisheye(capture, attempts.back(), simple_fits, colmap, dir, artifact)) {
        take_lenses(std::move(*fisheye));
        lenses = {};
      } else if (!choice.trials.empty()) {
        lenses = std::move(choice);
        if (lenses.chosen != CameraModel::kSimpleRadial) {
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
    LogWarning(std::string(options.second_attempt ? "" : "too few: ") +
               "trying again with larger photos and more features");
  }
  return outcome;
}

}  // namespace

void EstimatePoses(const fs::path& ingest_dir, const EstimateOptions& options, ArtifactWriter& artifact) {
  const Capture capture = LoadCapture(ingest_dir);
  const int n_images = int(capture.images.size());
  Colmap colmap(artifact.dir() / "colmap.log", options.stall_limit_seconds);
  artifact.facts()["colmap_version"] = colmap.version();

  if (options.second_attempt == true && (options.max_image_size || options.max_features)) {
    throw UsageError(
        "a second attempt chooses photo sizes and features by itself: leave either --second-attempt on out, or "
        "--sfm-image-size and --sfm-features");
  }
  Decision matching = needs::ExhaustiveMatching(n_images, capture.ordered);
  Force(matching, options.exhaustive);
  artifact.AddDecision(matching);
  const std::vector<GpsPosition> positions = GpsPositions(capture);
  Decision gps = needs::GpsPairs(matching.needed,
                                 positions.empty() ? std::nullopt : std::optional(Spread_m(LocalPositions(positions))));
  if (!matching.needed) {
    if (options.gps_pairs == true && positions.empty())
      throw InputError("pairs by GPS were asked for, but not every photo says where it was taken; leave that out");
    Force(gps, options.gps_pairs);
  }
  artifact.AddDecision(gps);

  const std::optional<BaseMapping> base =
      options.base.empty() ? std::nullopt : ReadBaseMapping(options.base, Asked(options));
  Outcome outcome = MakeAttempts(capture, options, matching.needed, gps.needed, base, colmap, artifact);
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
  std::optional<GrownFrom> grown_from;
  if (base && !MappedAnew(attempts[best])) {
    const auto same_world = [&](const ColmapModel& model) { return IsInBasesWorld(*base, capture, model); };
    grown_from = {base->own_focal_lengths, same_world};
  }
  FinalModel final = MakeFinalModel(capture, attempts[best], grown_from, options, colmap, artifact);
  if (final.mapped_again) outcome.attempts.push_back(std::move(*final.mapped_again));
  const ColmapModel working =
      base ? InBasesWorld(*base, capture, attempts[best], final.model(), artifact) : final.model();
  const ColmapModel full_size = AtFullSize(working, capture);
  const ColmapModel model = AsDisplayed(full_size, capture);
  fs::create_directories(artifact.dir() / kGivenModelDir);
  WriteColmapBinary(model, artifact.dir() / kGivenModelDir);
  RecordFacts(attempts, final.took_mapped_again ? attempts.back() : attempts[best], capture, model, artifact.facts());
  artifact.facts()["lens_trials"] = LensTrials(lenses);
  if (!groups.empty()) {
    artifact.facts()["groups"] = PiecesJson(capture, pieces);
    artifact.facts()["groups_advice"] = advice;
    LogWarning(groups + ". Going on with the largest. " + advice);
  }
  Certify(full_size, AtScale(final.options, MeanScale(working, full_size)), artifact);
  KeepMapping(attempts[best], final.own_focal ? final.shared : working, final.own_focal ? &working : nullptr,
              Asked(options), artifact.dir() / kMappingDir);
  fs::remove_all(artifact.dir() / kWorkDir);
  artifact.AddOutput(kGivenModelDir);
}

}  // namespace nrff
