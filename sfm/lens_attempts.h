// Attempts at a reconstruction with other lenses than the simple ones that one starts with, from its matches on.
#pragma once

#include <filesystem>
#include <optional>

#include "pipeline/manifest.h"
#include "sfm/capture.h"
#include "sfm/colmap_runner.h"
#include "sfm/lens_choice.h"
#include "sfm/reconstruct.h"

namespace nrff {

// `dir` is the attempt's folder, `artifact` keeps the seconds and is given needs::Fisheye. Both throw what Colmap
// throws.

// The attempt mapped as a fisheye's photos, where they may be that (wide by EXIF or, without, in the model found, whose
// simple lens does not fit: lens_choice.h) and show themselves to be it; else nothing.
std::optional<Attempt> AsFisheye(const Capture& capture, Attempt attempt, bool simple_fits, Colmap& colmap,
                                 const std::filesystem::path& dir, ArtifactWriter& artifact);

// The attempt with its largest model refined with the lenses chosen, and, where they are wide, made again with these:
// what mapping with simple ones left out lies at the corners, and of wide ones that is much.
Attempt WithRicherLenses(const Capture& capture, Attempt attempt, const LensChoice& choice, Colmap& colmap,
                         const std::filesystem::path& dir, const ArtifactWriter& artifact);

}  // namespace nrff
