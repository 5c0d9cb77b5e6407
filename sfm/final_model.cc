#include "sfm/final_model.h"

#include <algorithm>
#include <map>
#include <string>
#include <utility>

#include "pipeline/error.h"
#include "pipeline/log.h"
#include "pipeline/needs.h"
#include "sfm/lens_choice.h"

namespace nrff {
namespace {

constexpr double kLeastObservationRatio = 1.05;  // of photos mapped again

bool HasRicherLens(const ColmapModel& model) {
  return std::any_of(model.cameras.begin(), model.cameras.end(), [](const auto& camera) {
    const CameraModel lens = camera.second.model;
    return lens != CameraModel::kSimplePinhole && lens != CameraModel::kPinhole && lens != CameraModel::kSimpleRadial;
  });
}

Decision RefinementOf(size_t n_images, const EstimateOptions& options) {
  Decision refinement = needs::Refinement(n_images, kMostImagesForCovariance);
  Force(refinement, options.refine);
  return refinement;
}

Decision DecideOwnFocalLengths(const ColmapModel& shared, bool refined, const std::optional<GrownFrom>& grown_from,
                               const EstimateOptions& options) {
  if (options.own_focal_lengths) return needs::OwnFocalLengthsUntried("not tried");
  if (options.refine == false) return needs::OwnFocalLengthsUntried("refinement is left out");
  if (grown_from) return needs::OwnFocalLengthsUntried("photos were added to others", grown_from->own_focal_lengths);
  if (!refined) return needs::OwnFocalLengthsUntried("refinement is left out");
  if (const auto errors = TryOwnFocalLengths(shared, options.n_threads)) return needs::OwnFocalLengths(*errors);
  return needs::OwnFocalLengthsUntried("too few observations to hold some out, or no camera that photos share");
}

// With the cameras that `own` has.
Attempt MappedAgain(const Capture& capture, const Attempt& attempt, const ColmapModel& own, Colmap& colmap,
                    const ArtifactWriter& artifact) {
  std::map<uint32_t, ColmapCamera> by_image;
  for (const auto& [id, image] : own.images) by_image[id] = own.cameras.at(image.camera_id);
  Attempt again = ReconstructWithOwnCameras(capture, attempt, by_image, "own", colmap, artifact);
  again.settings.name += ", own focal lengths";
  return again;
}

// Puts it in the place of final.own_focal where it is the better one, and says in `own` what it came to.
void TakeMappedAgain(const Capture& capture, const Attempt& attempt, const std::optional<GrownFrom>& grown_from,
                     int n_threads, Colmap& colmap, const ArtifactWriter& artifact, Decision& own, FinalModel& final) {
  const ColmapModel& before = *final.own_focal;
  try {
    final.mapped_again = MappedAgain(capture, attempt, before, colmap, artifact);
  } catch (const Error& error) {
    if (error.code() != ExitCode::kExternalTool) throw;
    LogWarning("photos are not mapped again with their focal lengths: " + std::string(error.what()));
    return;
  }
  const ColmapModel* again = LargestModel(final.mapped_again->models);
  const size_t n_before = NumObservations(before), n_again = again ? NumObservations(*again) : 0;
  bool taken = again && again->images.size() >= before.images.size() &&
               double(n_again) >= kLeastObservationRatio * double(n_before);
  if (taken) {
    RefinedBundle better = WithOwnFocalLengths(*again, final.shared, n_threads);
    taken = better.certificate.accepted && (!grown_from || grown_from->same_world(better.model));
    if (taken) final.own_focal = std::move(better.model);
  }
  final.took_mapped_again = taken;
  const std::string found = "mapped again with these, " + std::to_string(n_again) + " observations agree instead of " +
                            std::to_string(n_before) + (taken ? "" : ": not taken");
  own.evidence += "; " + found;
  LogInfo(found);
}

}  // namespace

bool MayHaveOwnFocalLengths(size_t n_images, const EstimateOptions& options) {
  return options.own_focal_lengths.value_or(RefinementOf(n_images, options).needed);
}

FinalModel MakeFinalModel(const Capture& capture, const Attempt& attempt, const std::optional<GrownFrom>& grown_from,
                          const EstimateOptions& options, Colmap& colmap, ArtifactWriter& artifact) {
  const ColmapModel& found = *BestModel(attempt);
  const Decision refinement = RefinementOf(found.images.size(), options);
  artifact.AddDecision(refinement);
  FinalModel final;
  final.options = {.principal_points = HasRicherLens(found), .n_threads = options.n_threads};
  final.shared = refinement.needed ? RefineBundle(found, final.options).model : found;

  Decision own = DecideOwnFocalLengths(final.shared, refinement.needed, grown_from, options);
  Force(own, options.own_focal_lengths);
  if (own.needed) {
    LogInfo("a focal length for each photo: " + own.evidence + "; " + own.reason);
    RefinedBundle refined = WithOwnFocalLengths(final.shared, options.n_threads);
    if (refined.certificate.accepted) {
      final.options = OwnFocalLengthsAlone(options.n_threads);
      final.own_focal = std::move(refined.model);
      TakeMappedAgain(capture, attempt, grown_from, options.n_threads, colmap, artifact, own, final);
    } else {
      own.needed = false;
      own.reason = "the photos do not fix them: " + refined.certificate.reason;
      LogWarning("focal lengths stay shared; " + own.reason);
    }
  }
  artifact.AddDecision(own);
  return final;
}

}  // namespace nrff
