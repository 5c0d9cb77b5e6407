#include "render/kernels/camera_rays.h"
#include "render/kernels/pixel_ray.h"

namespace nrff {

template <typename Scalar>
void CameraRaysCpu(const CameraRaysArgs<Scalar>& args) {
#pragma omp parallel for schedule(static) if (args.n_rays > 1024)
  for (int64_t r = 0; r < args.n_rays; ++r) {
    const int32_t* pixel = args.pixels + 3 * r;
    PixelRay(args.cameras[pixel[0]], pixel[1], pixel[2], args.origins + 3 * r, args.directions + 3 * r);
  }
}

template void CameraRaysCpu(const CameraRaysArgs<float>&);
template void CameraRaysCpu(const CameraRaysArgs<double>&);

}  // namespace nrff
