#include <cmath>

#include "render/kernels/camera_rays.h"

namespace nrff {

template <typename Scalar>
void CameraRaysCpu(const CameraRaysArgs<Scalar>& args) {
#pragma omp parallel for schedule(static) if (args.n_rays > 1024)
  for (int64_t r = 0; r < args.n_rays; ++r) {
    const int32_t* pixel = args.pixels + 3 * r;
    const PinholeCamera& camera = args.cameras[pixel[0]];
    const double x = (pixel[1] + 0.5 - camera.cx) / camera.fx;
    const double y = (pixel[2] + 0.5 - camera.cy) / camera.fy;
    const double norm = 1 / std::sqrt(x * x + y * y + 1);
    for (int k = 0; k < 3; ++k) {
      const double* row = camera.scene_from_camera + 4 * k;
      args.origins[3 * r + k] = static_cast<Scalar>(row[3]);
      args.directions[3 * r + k] = static_cast<Scalar>((row[0] * x + row[1] * y + row[2]) * norm);
    }
  }
}

template void CameraRaysCpu(const CameraRaysArgs<float>&);
template void CameraRaysCpu(const CameraRaysArgs<double>&);

}  // namespace nrff
