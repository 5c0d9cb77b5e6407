// From photos to pinhole images: which pinhole camera, and its pixels by one resampling of the photo.
//
// The pinhole image keeps the photo's focal length, is cut so that every one of its pixels has a source, and is never
// larger than the photo's scale; where the photo has more pixels, they are averaged.
#pragma once

#include <Eigen/Core>
#include <optional>
#include <vector>

#include "sfm/colmap_model.h"
#include "sfm/distortion.h"
#include "sfm/image_io.h"

namespace nrff {

// What a photo becomes. px of the pinhole image are u·fx + cx, v·fy + cy (corner origin), as in COLMAP's PINHOLE.
struct PinholeTarget {
  int width = 0, height = 0;
  double fx = 0, fy = 0, cx = 0, cy = 0;
  bool undistort = false;  // false: the photo only scaled; its distortion is neglected

  ColmapCamera Camera(uint32_t id) const;
};

// How far the lens moves a pixel from where a pinhole camera of the same focal length and principal point has it: the
// largest over a grid on the photo, in px of an image whose longer side is `max_image_size` (or the photo's own, if
// that is less). Infinite when the grid has pixels that no ray reaches.
double LargestDisplacement(const Lens& lens, int max_image_size);

// The whole photo, scaled so that its longer side is at most `max_image_size`.
PinholeTarget ScaledTarget(const Lens& lens, int max_image_size);

// The largest rectangle (to within the bisection of one factor) whose pixels all have a source, scaled likewise; at
// most 60° to every side. Throws InputError when that is less than a tenth of the photo across.
PinholeTarget UndistortedTarget(const Lens& lens, int max_image_size);

// The photo's pixels in the target: the mean of n × n bilinear samples over each target pixel, where n is the number of
// photo pixels across it (rounded up), so that nothing is left out when scaling down and a photo that keeps its size is
// copied unchanged. Colours are weighted by alpha. `photo` must have the lens's size.
Image Resample(const Image& photo, const Lens& lens, const PinholeTarget& target);

// Where the target has what the photo shows at `px`; nothing outside the target.
std::optional<Eigen::Vector2d> TargetFromPhoto(const Eigen::Vector2d& px, const Lens& lens,
                                               const PinholeTarget& target);

}  // namespace nrff
