// Lens distortion of COLMAP's camera models, both ways, in double, with an explicit answer where there is none.
//
// Camera coordinates (u, v) = (x/z, y/z) of a point in front of the camera; image coordinates in px, origin at the
// image's corner. The forward direction has closed forms (src/base/camera_models.h of COLMAP 3.8); most of them fold:
// beyond some radius the image of a ray moves back inwards, and a pixel then has several rays or none. A Lens knows the
// radius up to which it is one-to-one and answers nothing beyond.
#pragma once

#include <Eigen/Core>
#include <optional>

#include "sfm/colmap_model.h"

namespace nrff {

class Lens {
 public:
  // Throws InputError when the number of parameters is not the model's, one is not finite, or a focal length is not
  // positive.
  explicit Lens(const ColmapCamera& camera);

  const ColmapCamera& camera() const { return camera_; }
  Eigen::Vector2d focal_px() const { return {fx_, fy_}; }
  Eigen::Vector2d principal_point_px() const { return {cx_, cy_}; }

  // Nothing beyond ValidRadius.
  std::optional<Eigen::Vector2d> ImageFromCamera(const Eigen::Vector2d& uv) const;
  // Inverse of ImageFromCamera to about 1e-12 (in u and v): bisection along the radius, then safeguarded Newton steps.
  // Nothing for pixels that no ray within ValidRadius reaches.
  std::optional<Eigen::Vector2d> CameraFromImage(const Eigen::Vector2d& px) const;

  // |(u, v)| below which distortion is one-to-one (its Jacobian's determinant is positive all the way from the centre,
  // in every direction), at most kLargestRadius.
  double ValidRadius() const { return valid_radius_; }

  static constexpr double kLargestRadius = 50;  // 88.9° off axis: what a pinhole image cannot hold anyway

 private:
  double FindValidRadius() const;

  ColmapCamera camera_;
  double fx_ = 0, fy_ = 0, cx_ = 0, cy_ = 0;
  size_t first_distortion_ = 0;  // index of the first parameter after the principal point
  double valid_radius_ = 0;
};

}  // namespace nrff
