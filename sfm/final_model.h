// What becomes of the model that the best attempt found: it is refined, with a focal length for each photo where photos
// need it.
#pragma once

#include <cstddef>
#include <functional>
#include <optional>

#include "pipeline/manifest.h"
#include "sfm/bundle_refinement.h"
#include "sfm/capture.h"
#include "sfm/colmap_model.h"
#include "sfm/colmap_runner.h"
#include "sfm/estimate.h"
#include "sfm/reconstruct.h"

namespace nrff {

struct FinalModel {
  ColmapModel shared;                    // as COLMAP can go on from it
  std::optional<ColmapModel> own_focal;  // with a focal length for each image
  BundleOptions options;                 // what model() was solved with, or would have been
  std::optional<Attempt> mapped_again;   // for own focal lengths
  bool took_mapped_again = false;

  const ColmapModel& model() const { return own_focal ? *own_focal : shared; }
};

// The earlier model that a grown one comes from.
struct GrownFrom {
  bool own_focal_lengths = false;
  std::function<bool(const ColmapModel& model)> same_world;  // whether this one can take its place
};

// Whether photos of so large a model may come to have focal lengths of their own.
bool MayHaveOwnFocalLengths(size_t n_images, const EstimateOptions& options);

// Of the attempt's best model; `grown_from`: none where it was mapped from scratch. Where own focal lengths are needed,
// photos are mapped again from the attempt's matches with a camera for each: with a shared one, zoomed photos were bent
// into place (28 to 50 mm without EXIF: positions off by 9.8 % of their radius after refinement, 0.1 % mapped again).
// That model counts where it places no fewer photos and 5 % more observations (these 13 %; cup_simple_pinhole, which
// focused anew, 1.9 %, and its positions were off by 16.6 ‰ instead of 10.6), and, of a grown one, in the same world.
// Where COLMAP fails at it the refined one stays. Adds needs::Refinement and OwnFocalLengths to the artifact.
FinalModel MakeFinalModel(const Capture& capture, const Attempt& attempt, const std::optional<GrownFrom>& grown_from,
                          const EstimateOptions& options, Colmap& colmap, ArtifactWriter& artifact);

}  // namespace nrff
