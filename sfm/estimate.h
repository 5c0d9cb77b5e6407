// Poses from photos: COLMAP run on small copies of the capture's photos, with settings chosen for the capture, its
// progress shown, its result checked. What an interrupted attempt left in the partial directory is used.
#pragma once

#include <cstdint>
#include <filesystem>
#include <optional>

#include "pipeline/manifest.h"
#include "sfm/colmap_model.h"

namespace nrff {

struct EstimateOptions {
  uint64_t seed = 0;
  std::optional<bool> exhaustive;  // matching forced either way
  // Instead of what is chosen for the capture; then there is no second attempt.
  std::optional<int> max_image_size;        // px, longer side of the photos that features are found in
  std::optional<int> max_features;          // per photo
  std::optional<CameraModel> camera_model;  // of all lenses; then no other is tried
  // Decisions forced either way.
  std::optional<bool> refine;  // the model found, by bundle_refinement.h
  std::optional<bool> own_focal_lengths, gps_pairs, second_attempt;
  std::filesystem::path base;        // an artifact of fewer of the photos, under the same ids; empty: none
  double stall_limit_seconds = 300;  // the longest COLMAP may neither print nor use the processor
  int n_threads = 1;
};

// Reads `ingest_dir`/capture.json; writes sparse/*.bin (image names are ids, cameras of the photos' own size),
// colmap.log, facts and decisions into the artifact. A second attempt with larger photos, more features and more pairs
// is made where needs::SecondAttempt says so; the better one counts. Lenses are SIMPLE_RADIAL, and richer ones where
// needs::RicherLens says so (lens_choice.h): then matches are verified and photos mapped again with these, and the
// result is refined where needs::Refinement says so (bundle_refinement.h), principal points only where lenses are
// richer: freed with simple ones they turned maryrose's cameras by 0.64° from the given ones instead of 0.05°. Photos
// of a group share a camera, unless needs::OwnFocalLengths gives each a focal length of its own at the very end, with
// which photos are mapped again (final_model.h); that is part of refinement and left out with it. Photos that fall into
// groups which nothing joins are listed in groups/N.txt, and the largest group goes on. What another estimate can go on
// from stays in mapping/, and how well the photos fix the model in refinement.json (bundle_refinement.h; up to
// kMostImagesForCovariance photos); both are no payload.
//
// With a base, its model grows by the added photos (Reconstruct), is checked (needs::SameWorld) and laid over the
// base's world. Where it does not hold or lacks photos, all are mapped from scratch, of the features and matches that
// there are, and the model with more photos counts. extension.json says whether the world is the base's:
// {"schema_version", "frame_kept", "n_earlier", "n_added", "n_added_placed", "n_earlier_lost", "mapped_anew",
// "shift_px", "largest_shift_px", "error_before_px", "error_px"}, in px of the working photos; the fact "extension" is
// the same.
//
// Throws ExternalToolError (COLMAP missing, failing, hanging) naming its log, and InputError with a diagnosis, or with
// the groups, when fewer than kFewestImages, or less than kFewest of the photos, could be placed together.
void EstimatePoses(const std::filesystem::path& ingest_dir, const EstimateOptions& options, ArtifactWriter& artifact);

inline constexpr double kFewest = 0.5;
inline constexpr int kFewestImages = 3;

}  // namespace nrff
