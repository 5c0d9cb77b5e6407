// Poses from photos: COLMAP run on small copies of the capture's photos, with settings chosen for the capture, its
// progress shown, its result checked. What an interrupted attempt left in the partial directory is used.
#pragma once

#include <cstdint>
#include <filesystem>
#include <optional>

#include "pipeline/manifest.h"

namespace nrff {

struct EstimateOptions {
  uint64_t seed = 0;
  std::optional<bool> exhaustive;    // matching forced either way
  // Instead of what is chosen for the capture; then there is no second attempt.
  std::optional<int> max_image_size;  // px, longer side of the photos that features are found in
  std::optional<int> max_features;    // per photo
  double stall_limit_seconds = 300;  // the longest COLMAP may neither print nor use the processor
  int n_threads = 1;
};

// Reads `ingest_dir`/capture.json; writes sparse/*.bin (image names are ids, cameras of the photos' own size),
// colmap.log, facts and decisions into the artifact. A second attempt with larger photos, more features and more pairs
// is made when the first registers fewer than kEnough of the photos; the better one counts.
//
// Throws ExternalToolError (COLMAP missing, failing, hanging) naming its log, and InputError with a diagnosis when
// fewer than kFewestImages, or less than kFewest of the photos, could be placed.
void EstimatePoses(const std::filesystem::path& ingest_dir, const EstimateOptions& options, ArtifactWriter& artifact);

inline constexpr double kEnough = 0.8;
inline constexpr double kFewest = 0.5;
inline constexpr int kFewestImages = 3;

}  // namespace nrff
