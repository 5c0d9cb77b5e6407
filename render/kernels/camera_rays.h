// Rays through pixels of pinhole cameras.
//
// The ray of pixel (ix, iy) goes through the pixel's centre (ix + 0.5, iy + 0.5); camera axes are OpenCV's (x right,
// y down, z forward). All arithmetic is double; only the results are rounded to Scalar.
#pragma once

#include <cstdint>

namespace nrff {

struct PinholeCamera {
  double fx = 1, fy = 1, cx = 0, cy = 0;  // px, corner-origin convention
  double scene_from_camera[12] = {};      // rows of [R | t], rigid
};

template <typename Scalar>
struct CameraRaysArgs {
  // inputs
  int64_t n_rays = 0;
  const PinholeCamera* cameras = nullptr;  // [n_cameras]
  const int32_t* pixels = nullptr;         // [n_rays, 3]: camera, ix, iy
  // outputs, overwritten
  Scalar* origins = nullptr;     // [n_rays, 3] scene units
  Scalar* directions = nullptr;  // [n_rays, 3] unit
};

// Defined for float and double.
template <typename Scalar>
void CameraRaysCpu(const CameraRaysArgs<Scalar>& args);

}  // namespace nrff
