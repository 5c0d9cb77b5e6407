// The normal that the spatial network names and the view direction reflected at it, shared by the CPU and CUDA twins:
//   n = −raw/|raw|,  c = −d·n,  o = 2 c n + d,  d the ray's direction
#pragma once

#include <cmath>

#include "model/kernels/simd.h"

namespace nrff {

struct Reflection {
  float normal[3], inverse_norm, cosine, reflected[3];

  NRFF_INLINE Reflection(float x, float y, float z, float dx, float dy, float dz) {
    const float norm = std::sqrt(x * x + y * y + z * z);
    inverse_norm = 1 / (norm > 1e-12F ? norm : 1e-12F);
    normal[0] = -x * inverse_norm;
    normal[1] = -y * inverse_norm;
    normal[2] = -z * inverse_norm;
    cosine = -(dx * normal[0] + dy * normal[1] + dz * normal[2]);
    reflected[0] = 2 * cosine * normal[0] + dx;
    reflected[1] = 2 * cosine * normal[1] + dy;
    reflected[2] = 2 * cosine * normal[2] + dz;
  }
};

// d_raw [3] from the gradients of the cosine, the reflected direction and, from elsewhere, the normal.
NRFF_INLINE void ReflectionBackward(const float* normal, float inverse_norm, float cosine, const float* direction,
                                    float d_cosine, const float* d_reflected, const float* d_normal, float* d_raw) {
  const float d_c =
      d_cosine + 2 * (d_reflected[0] * normal[0] + d_reflected[1] * normal[1] + d_reflected[2] * normal[2]);
  const float x = d_normal[0] + 2 * cosine * d_reflected[0] - d_c * direction[0];
  const float y = d_normal[1] + 2 * cosine * d_reflected[1] - d_c * direction[1];
  const float z = d_normal[2] + 2 * cosine * d_reflected[2] - d_c * direction[2];
  const float along = x * normal[0] + y * normal[1] + z * normal[2];
  d_raw[0] = (along * normal[0] - x) * inverse_norm;
  d_raw[1] = (along * normal[1] - y) * inverse_norm;
  d_raw[2] = (along * normal[2] - z) * inverse_norm;
}

}  // namespace nrff
