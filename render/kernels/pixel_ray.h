// The arithmetic of one pixel, shared by the CPU and CUDA twins: the ray through it and the colour it should have.
#pragma once

#include <cmath>
#include <cstdint>

#include "render/kernels/camera_rays.h"
#include "render/kernels/device.h"

namespace nrff {

// camera_rays.h; origin and direction [3].
template <typename Scalar>
NRFF_HOST_DEVICE inline void PixelRay(const PinholeCamera& camera, int ix, int iy, Scalar* origin, Scalar* direction) {
  const double x = (ix + 0.5 - camera.cx) / camera.fx;
  const double y = (iy + 0.5 - camera.cy) / camera.fy;
  const double norm = 1 / std::sqrt(x * x + y * y + 1);
  for (int k = 0; k < 3; ++k) {
    const double* row = camera.scene_from_camera + 4 * k;
    origin[k] = static_cast<Scalar>(row[3]);
    direction[k] = static_cast<Scalar>((row[0] * x + row[1] * y + row[2]) * norm);
  }
}

// The pixel of a masked view (scene.h) that is number k, from 0, of those that count, row by row. pixels [height,
// width, 4]; rows_before [height + 1]: how many count above each row.
NRFF_HOST_DEVICE inline void CountingPixel(const uint8_t* pixels, const uint32_t* rows_before, int width, int height,
                                           uint32_t k, int* ix, int* iy) {
  int low = 0, high = height;  // rows_before[low] ≤ k < rows_before[high]
  while (high - low > 1) {
    const int middle = (low + high) / 2;
    (rows_before[middle] <= k ? low : high) = middle;
  }
  const uint8_t* alpha = pixels + static_cast<int64_t>(low) * width * 4 + 3;
  int x = 0;
  for (uint32_t left = k - rows_before[low];; ++x) {
    if (alpha[4 * static_cast<int64_t>(x)] == 255 && left-- == 0) break;
  }
  *ix = x;
  *iy = low;
}

// Composited onto a grey level. pixel [n_channels]: 3, or 4 with alpha; colour [3] in [0, 1].
NRFF_HOST_DEVICE inline void PixelColour(const uint8_t* pixel, int n_channels, float background, float* colour) {
  const float alpha = n_channels == 4 ? static_cast<float>(pixel[3]) / 255 : 1;
  for (int c = 0; c < 3; ++c) colour[c] = alpha * static_cast<float>(pixel[c]) / 255 + (1 - alpha) * background;
}

}  // namespace nrff
