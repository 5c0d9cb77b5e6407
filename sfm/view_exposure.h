// How bright the views of a scene are against each other: from the colours in which they show the same points, or,
// where there are none, from what the camera wrote into the photos.
//
// A point p has one colour in the light that falls on it, and view v shows it times its gain, channel by channel, in
// display-referred values (exposure and white balance are close to a factor there, too, as these go with a root of the
// light): log c_pv = a_p + g_v. Robust least squares (Cauchy weights) over all training views' sightings, the points
// eliminated; a small prior holds views without points at 1. Held-out views keep a gain of 1: nothing of them is used.
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/scene.h"
#include "sfm/colmap_model.h"

namespace nrff {

// What the camera wrote; each may be missing.
struct WrittenExposure {
  std::optional<double> seconds, f_number, iso;

  // The base-2 logarithm of seconds · iso / f_number², up to a constant; nothing where one of them is missing.
  std::optional<double> Ev() const;
};

struct ViewExposures {
  std::string source;      // "points", "EXIF" or "none"
  std::vector<Vec3> gain;  // of scene.views: View::colour_gain; the geometric mean of the training views is 1
};

// `model`: pinhole cameras, observations in px of the scene's views; `view_of_image`: COLMAP image id → index into
// scene.views; `written`: of scene.views. EXIF counts only where every training view has it, as one exposure would have
// nothing to be compared with.
ViewExposures MeasureViewExposures(const ColmapModel& model, const std::map<uint32_t, uint32_t>& view_of_image,
                                   const Scene& scene, const ImagePack& pack,
                                   const std::vector<WrittenExposure>& written);

}  // namespace nrff
