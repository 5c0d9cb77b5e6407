#include "sfm/final_model.h"

#include <algorithm>
#include <map>
#include <string>
#include <utility>

#include "pipeline/log.h"
#include "pipeline/needs.h"
#include "sfm/lens_choice.h"

namespace nrff {
namespace {

bool HasRicherLens(const ColmapModel& model) {
  return std::any_of(model.cameras.begin(), model.cameras.end(), [](const auto& camera) {
    const CameraModel lens = camera.second.model;
    return lens != CameraModel::kSimplePinhole && lens != CameraModel::kPinhole && lens != CameraModel::kSimpleRadial;
  });
}

Decision DecideOwnFocalLengths(const ColmapModel& shared, bool refined, std::optional<bool> own_before,
                               const EstimateOptions& options) {
  if (options.own_focal_lengths) return needs::OwnFocalLengthsUntried("not tried");
  if (own_before) return needs::OwnFocalLengthsUntried("photos were added to others", *own_before);
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
  again.n_pairs = 0;  // none were verified
  return again;
}

}  // namespace

FinalModel MakeFinalModel(const Capture& capture, const Attempt& attempt, std::optional<bool> own_before,
                          const EstimateOptions& options, Colmap& colmap, ArtifactWriter& artifact) {
  const ColmapModel& found = *BestModel(attempt);
  Decision refinement = needs::Refinement(found.images.size(), kMostImagesForCovariance);
  Force(refinement, options.refine);
  artifact.AddDecision(refinement);
  FinalModel final;
  final.options = {.principal_points = HasRicherLens(found), .n_threads = options.n_threads};
  final.shared = refinement.needed ? RefineBundle(found, final.options).model : found;

  Decision own = DecideOwnFocalLengths(final.shared, refinement.needed, own_before, options);
  Force(own, options.own_focal_lengths);
  if (own.needed) {
    LogInfo("a focal length for each photo: " + own.evidence + "; " + own.reason);
    RefinedBundle refined = WithOwnFocalLengths(final.shared, options.n_threads);
    if (refined.certificate.accepted) {
      final.options = OwnFocalLengthsAlone(options.n_threads);
      const size_t n_observations = NumObservations(refined.model);
      final.mapped_again = MappedAgain(capture, attempt, refined.model, colmap, artifact);
      const ColmapModel* again = LargestModel(final.mapped_again->models);
      const size_t n_again = again ? NumObservations(*again) : 0;
      const std::string agree = std::to_string(n_again) +
                                " observations agree where photos are mapped again with it, " +
                                std::to_string(n_observations) + " before";
      own.evidence += "; " + agree;
      LogInfo(agree);
      final.own_focal = std::move(refined.model);
      if (again && again->images.size() >= found.images.size() && n_again >= n_observations) {
        RefinedBundle better = WithOwnFocalLengths(*again, final.shared, options.n_threads);
        if (better.certificate.accepted) final.own_focal = std::move(better.model);
      }
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
