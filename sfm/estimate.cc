#include "sfm/estimate.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/extension.h"
#include "pipeline/files.h"
#include "pipeline/log.h"
#include "sfm/bundle_refinement.h"
#include "sfm/capture.h"
#include "sfm/colmap_model.h"
#include "sfm/colmap_runner.h"
#include "sfm/gps.h"
#include "sfm/lens_choice.h"
#include "sfm/merged_model.h"
#include "sfm/pieces.h"
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
constexpr char kPieceLists[] = "groups";

constexpr char kGivenSettings[] = "given";

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

// What the attempt came to: the earlier model grown by the added photos, unless mapping from scratch placed more.
const ColmapModel* BestModel(const Attempt& attempt) {
  const ColmapModel* largest = LargestModel(attempt.models);
  if (!attempt.grown) return largest;
  return largest && largest->images.size() > attempt.grown->images.size() ? largest : &*attempt.grown;
}

size_t NumRegistered(const Attempt& attempt) {
  const ColmapModel* best = BestModel(attempt);
  return best ? best->images.size() : 0;
}

// Of the cameras with that model, by group.
std::map<int, ColmapCamera> LensesByGroup(const Capture& capture, const ColmapModel& model, CameraModel camera_model) {
  std::map<std::string, int> group_of;
  for (const CaptureImage& photo : capture.images) group_of[WorkingPhotoName(photo)] = photo.camera;
  std::map<int, ColmapCamera> lenses;
  for (const auto& [id, image] : model.images) {
    const ColmapCamera& camera = model.cameras.at(image.camera_id);
    if (const auto group = group_of.find(image.name); group != group_of.end() && camera.model == camera_model)
      lenses[group->second] = camera;
  }
  return lenses;
}

ColmapModel Refined(const ColmapModel& model, int n_threads) {
  BundleOptions options;
  options.n_threads = n_threads;
  return RefineBundle(model, options).model;
}

// Of photos that say so little of their lens that it may be a fisheye, by group: what one of that focal length would
// be, without one a fisheye of 160° between corners. None where no group may be of one: by EXIF it is not wide, or,
// without, the model found is not.
std::map<int, ColmapCamera> FisheyeGuesses(const Capture& capture, const Attempt& attempt) {
  constexpr double kFieldByExif_deg = 90;  // of a pinhole of that focal length: 21.6 mm
  constexpr double kFieldGuessed_deg = 160;
  double found_deg = 180;
  if (const ColmapModel* largest = LargestModel(attempt.models)) {
    found_deg = 0;
    for (const auto& [id, camera] : largest->cameras) found_deg = std::max(found_deg, FieldOfView_deg(camera));
  }
  std::map<int, ColmapCamera> guesses;
  for (const CaptureImage& photo : capture.images) {
    const ImageInfo& info = photo.info;
    const double half_px = std::hypot(info.width, info.height) / 2;
    const bool wide = info.focal_px ? 2 * std::atan(half_px / *info.focal_px) * 180 / M_PI >= kFieldByExif_deg
                                    : found_deg >= kWide_deg;
    if (!wide || guesses.contains(photo.camera)) continue;
    const double focal_px = info.focal_px.value_or(half_px / (kFieldGuessed_deg / 2 * M_PI / 180));
    guesses[photo.camera] = {0,
                             CameraModel::kOpenCVFisheye,
                             info.width,
                             info.height,
                             {focal_px, focal_px, info.width / 2.0, info.height / 2.0, 0, 0, 0, 0}};
  }
  return guesses;
}

size_t NumObservations(const Attempt& attempt) {
  size_t n = 0;
  if (const ColmapModel* largest = LargestModel(attempt.models)) {
    for (const auto& [id, point] : largest->points) n += point.track.size();
  }
  return n;
}

// From the same matches as a fisheye's photos, where they may and do show themselves to be that.
std::optional<Attempt> AsFisheye(const Capture& capture, Attempt attempt, Colmap& colmap, const fs::path& dir,
                                 ArtifactWriter& artifact) {
  const int n_placed = int(NumRegistered(attempt));
  const size_t n_observations = NumObservations(attempt);
  attempt.settings.lenses = FisheyeGuesses(capture, attempt);
  if (attempt.settings.lenses.empty()) return {};
  attempt.settings.name += ", as fisheyes";
  Attempt fisheye = ReconstructWithLenses(capture, attempt, "fisheye", colmap, dir, artifact);
  const Decision decision =
      needs::Fisheye(n_placed, n_observations, int(NumRegistered(fisheye)), NumObservations(fisheye));
  artifact.AddDecision(decision);
  LogInfo(decision.evidence + ": " + decision.reason);
  if (!decision.needed) return {};
  for (auto& [group, lens] : LensesByGroup(capture, *LargestModel(fisheye.models), CameraModel::kOpenCVFisheye))
    fisheye.settings.lenses[group] = lens;
  return fisheye;
}

// The attempt with its largest model refined with richer lenses, and, where they are wide, made again with these: what
// mapping with simple ones left out lies at the corners, and of wide ones that is much.
Attempt WithRicherLenses(const Capture& capture, Attempt attempt, const LensChoice& choice, Colmap& colmap,
                         const fs::path& dir, const ArtifactWriter& artifact) {
  ColmapModel& largest = attempt.models[size_t(LargestModel(attempt.models) - attempt.models.data())];
  largest = Refined(WithLenses(largest, choice.chosen), attempt.settings.n_threads);
  attempt.settings.lenses = LensesByGroup(capture, largest, choice.chosen);
  attempt.settings.name += ", richer lenses";
  attempt.seconds_features = attempt.seconds_matching = attempt.seconds_mapping = 0;
  attempt.n_pairs = 0;
  const bool wide = std::any_of(attempt.settings.lenses.begin(), attempt.settings.lenses.end(),
                                [](const auto& lens) { return FieldOfView_deg(lens.second) >= kWide_deg; });
  if (!wide) return attempt;
  Attempt again = ReconstructWithLenses(capture, attempt, "lenses", colmap, dir, artifact);
  return NumRegistered(again) >= NumRegistered(attempt) ? again : attempt;
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

constexpr char kDatabaseFile[] = "database.db", kModelFolder[] = "model", kSettingsFile[] = "settings.json";

// What another estimate can go on from.
void KeepMapping(const Attempt& attempt, const ColmapModel& working, const fs::path& dir) {
  fs::create_directories(dir / kModelFolder);
  fs::copy_file(attempt.database_file, dir / kDatabaseFile, fs::copy_options::overwrite_existing);
  WriteColmapBinary(working, dir / kModelFolder);
  Json settings = ToJson(attempt.settings);
  settings["photos"] = Json::array();
  for (const auto& [id, image] : attempt.database.images) settings["photos"].push_back(image.name);
  WriteJson(dir / kSettingsFile, settings);
}

// An estimate of fewer of the photos.
struct Base {
  SfmSettings settings;
  EarlierMapping mapping;
  ColmapModel model;
  std::set<std::string> photos;  // working names
};

// Nothing, with a warning, where other settings are asked for now than it was made with.
std::optional<Base> ReadBase(const EstimateOptions& options) {
  if (options.base.empty()) return {};
  const fs::path dir = options.base / kMappingDir, settings = dir / kSettingsFile;
  Base base;
  const Json json = ReadJson(settings);
  base.settings = SfmSettingsFromJson(json, EscapePath(settings));
  const bool given = options.max_image_size || options.max_features;
  if (given != (base.settings.name == kGivenSettings) ||
      options.max_image_size.value_or(base.settings.max_image_size) != base.settings.max_image_size ||
      options.max_features.value_or(base.settings.max_features) != base.settings.max_features) {
    LogWarning("poses are estimated anew: the earlier features were found with other settings");
    return {};
  }
  base.photos = Get<std::set<std::string>>(json, "photos", EscapePath(settings));
  base.mapping = {dir / kDatabaseFile, dir / kModelFolder, base.photos, {}};
  base.model = ReadColmapModel(base.mapping.model);
  return base;
}

MergedModel Compare(const Base& base, const Capture& capture, const ColmapModel& now,
                    const std::optional<WorldShift>& shift) {
  MergedModel merged;
  merged.n_earlier = base.photos.size();
  merged.n_added = capture.images.size() - merged.n_earlier;
  merged.n_earlier_placed = base.model.images.size();
  std::set<std::string> placed;
  for (const auto& [id, image] : now.images) {
    placed.insert(image.name);
    merged.n_added_placed += base.photos.contains(image.name) ? 0 : 1;
  }
  for (const auto& [id, image] : base.model.images) merged.n_lost += placed.contains(image.name) ? 0 : 1;
  merged.error_before_px = MeanError(base.model);
  merged.error_px = MeanError(now);
  if (shift) merged.shift_px = shift->median_px;
  return merged;
}

// The base's model grown by the added photos, and, where that does not hold, what is mapped anew.
Attempt Extend(const Base& base, SfmSettings settings, const Capture& capture, Colmap& colmap, const fs::path& work,
               const ArtifactWriter& artifact) {
  EarlierMapping mapping = base.mapping;
  const auto holds = [&](const ColmapModel& grown) {
    return needs::SameWorld(Compare(base, capture, grown, MeasureShift(base.model, grown)));
  };
  mapping.holds = holds;
  const std::string name = settings.name;
  settings.name = "extended";  // its folder is no other attempt's
  Attempt attempt = Reconstruct(capture, settings, colmap, work / settings.name, artifact, &mapping);
  attempt.settings.name = name;
  const ColmapModel* anew = LargestModel(attempt.models);
  const bool replaceable = attempt.grown && anew && anew->images.size() >= attempt.grown->images.size();
  if (replaceable && !holds(*attempt.grown)) attempt.grown.reset();
  return attempt;
}

// The model in the base's world where the two can be laid over each other; says what came of the base.
ColmapModel InBasesWorld(const Base& base, const Capture& capture, const Attempt& attempt, ColmapModel model,
                         ArtifactWriter& artifact) {
  const std::optional<WorldShift> shift = MeasureShift(base.model, model);
  const MergedModel merged = Compare(base, capture, model, shift);
  const bool mapped_anew = BestModel(attempt) != (attempt.grown ? &*attempt.grown : nullptr);
  const bool frame_kept = needs::SameWorld(merged);
  artifact.AddDecision(needs::PosesAnew(merged, mapped_anew));
  const Json extension = {
      {"schema_version", kExtensionSchemaVersion},
      {"frame_kept", frame_kept},
      {"n_earlier", merged.n_earlier},
      {"n_added", merged.n_added},
      {"n_added_placed", merged.n_added_placed},
      {"n_earlier_lost", merged.n_lost},
      {"mapped_anew", mapped_anew},
      {"shift_px", shift ? Json(shift->median_px) : Json()},
      {"largest_shift_px", shift && std::isfinite(shift->largest_px) ? Json(shift->largest_px) : Json()},
      {"error_before_px", merged.error_before_px},
      {"error_px", merged.error_px}};
  WriteJson(artifact.dir() / kExtensionFile, extension);
  artifact.AddOutput(kExtensionFile);
  artifact.facts()["extension"] = extension;
  if (!frame_kept) LogWarning("the model is not in the world of the earlier one: what follows is made anew");
  return shift ? Transformed(model, shift->earlier_from_now) : std::move(model);
}

// How well the photos fix the model, for people and the report; no payload, as it holds times.
void Certify(const ColmapModel& model, int n_threads, ArtifactWriter& artifact) {
  if (model.images.size() > kMostImagesForCovariance) {
    LogInfo("how well the photos fix the poses is not measured beyond " + std::to_string(kMostImagesForCovariance));
    return;
  }
  BundleOptions options;
  options.n_threads = n_threads;
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
  const auto take = [&](Attempt attempt) {
    attempts.push_back(std::move(attempt));
    if (NumRegistered(attempts.back()) > NumRegistered(attempts[best])) best = attempts.size() - 1;
    LogInfo(std::to_string(NumRegistered(attempts.back())) + " of " + std::to_string(n_images) + " photos registered");
  };
  const bool given = options.max_image_size || options.max_features;
  const auto adapt = [&](SfmSettings& settings) {
    settings.exhaustive = matching.needed;
    settings.seed = options.seed;
    settings.n_threads = options.n_threads;
    if (gps_pairs) settings.n_nearest = kNearest;
  };
  const std::optional<Base> base = ReadBase(options);
  if (base) {
    SfmSettings settings = base->settings;
    adapt(settings);
    attempts.push_back(Extend(*base, settings, capture, colmap, work, artifact));
    LogInfo(std::to_string(NumRegistered(attempts.back())) + " of " + std::to_string(n_images) +
            " photos registered, " + std::to_string(base->model.images.size()) + " of them were");
  }
  const bool extended = base && double(NumRegistered(attempts.back())) >= needs::kEnoughPlaced * n_images;
  if (base && !extended) LogWarning("too few: estimating all poses anew");
  Pieces pieces;      // of the best attempt
  LensChoice lenses;  // of the first that there is enough to judge by
  for (const int level : {given ? 0 : first_level, first_level + 1}) {
    if (extended) break;
    SfmSettings settings = Settings(level);
    adapt(settings);
    if (given) {
      settings.name = kGivenSettings;
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
      if (auto fisheye = AsFisheye(capture, attempts.back(), colmap, dir, artifact)) {
        take_lenses(std::move(*fisheye));
      } else if (const ColmapModel* largest = LargestModel(attempts.back().models); largest && lenses.trials.empty()) {
        lenses = ChooseLens(*largest, options.n_threads);
        if (lenses.chosen != CameraModel::kSimpleRadial) {
          LogInfo("lenses of the model " + std::string(CameraModelName(lenses.chosen)) + ": " +
                  lenses.decision->evidence);
          take_lenses(WithRicherLenses(capture, attempts.back(), lenses, colmap, dir, artifact));
        }
      }
    }
    pieces = FindPieces(capture, attempts[best].database, attempts[best].models);
    if (given || level > first_level) break;
    const Decision again = needs::SecondAttempt(n_images, int(NumRegistered(attempts[best])), int(pieces.pieces.size()),
                                                pieces.NumPlaced(), pieces.n_holding);
    artifact.AddDecision(again);
    if (!again.needed) break;
    LogWarning("too few: trying again with larger photos and more features");
  }
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
  const bool richer = !attempts[best].settings.lenses.empty();
  const bool refine = options.refine.value_or(richer) && largest->images.size() <= kMostImagesForCovariance;
  const ColmapModel found = refine ? Refined(*largest, options.n_threads) : *largest;
  artifact.facts()["refined"] = refine;
  const ColmapModel working = base ? InBasesWorld(*base, capture, attempts[best], found, artifact) : found;
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
  KeepMapping(attempts[best], working, artifact.dir() / kMappingDir);
  fs::remove_all(work);
  artifact.AddOutput(kGivenModelDir);
}

}  // namespace nrff
