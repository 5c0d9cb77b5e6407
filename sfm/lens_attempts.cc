#include "sfm/lens_attempts.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <string>

#include "pipeline/log.h"
#include "sfm/bundle_refinement.h"
#include "sfm/sensor_frame.h"
#include "sfm/working_photos.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

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

// Of photos that say so little of their lens that it may be a fisheye, by group: what one of that focal length would
// be, without one a fisheye of 160° between corners. None where no group may be of one: by EXIF it is not wide, or,
// without, the model found is not, or its simple lens fits.
std::map<int, ColmapCamera> FisheyeGuesses(const Capture& capture, const Attempt& attempt, bool simple_fits) {
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
                                    : found_deg >= kWide_deg && !simple_fits;
    if (!wide || guesses.contains(photo.camera)) continue;
    const double focal_px = info.focal_px.value_or(half_px / (kFieldGuessed_deg / 2 * M_PI / 180));
    const auto [width, height] = SensorSize(info);
    guesses[photo.camera] = {
        0, CameraModel::kOpenCVFisheye, width, height, {focal_px, focal_px, width / 2.0, height / 2.0, 0, 0, 0, 0}};
  }
  return guesses;
}

size_t NumObservations(const Attempt& attempt) {
  const ColmapModel* largest = LargestModel(attempt.models);
  return largest ? NumObservations(*largest) : 0;
}

}  // namespace

std::optional<Attempt> AsFisheye(const Capture& capture, Attempt attempt, bool simple_fits, Colmap& colmap,
                                 const fs::path& dir, ArtifactWriter& artifact) {
  const int n_placed = int(NumRegistered(attempt));
  const size_t n_observations = NumObservations(attempt);
  attempt.settings.lenses = FisheyeGuesses(capture, attempt, simple_fits);
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

Attempt WithRicherLenses(const Capture& capture, Attempt attempt, const LensChoice& choice, Colmap& colmap,
                         const fs::path& dir, const ArtifactWriter& artifact) {
  ColmapModel& largest = attempt.models[size_t(LargestModel(attempt.models) - attempt.models.data())];
  largest = RefineBundle(WithLenses(largest, choice.chosen), {.n_threads = attempt.settings.n_threads}).model;
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

}  // namespace nrff
