// The ray to a point whose distance is known, shared by the CPU and CUDA twins.
#pragma once

#include <cmath>

#include "render/kernels/device.h"
#include "render/scene_map.h"

namespace nrff {

struct DepthTarget {
  double center[3];    // of the camera, scene units
  double position[3];  // of the point
  double sigma = 0;    // standard deviation of its distance
};

// origin, direction [3]: from the camera through the point. distance of the point; spread: its standard deviation and
// the marching step there, added in quadrature.
NRFF_HOST_DEVICE inline void DepthRay(const DepthTarget& target, const SceneMap& map, double march_step, float* origin,
                                      float* direction, float* distance, float* spread) {
  double unit[3], squared = 0;
  for (int k = 0; k < 3; ++k) {
    unit[k] = target.position[k] - target.center[k];
    squared += unit[k] * unit[k];
  }
  const double norm = std::sqrt(squared);
  for (int k = 0; k < 3; ++k) {
    unit[k] /= norm;
    origin[k] = static_cast<float>(target.center[k]);
    direction[k] = static_cast<float>(unit[k]);
  }
  *distance = static_cast<float>(norm);
  *spread = static_cast<float>(std::hypot(target.sigma, map.StepAt(target.position, unit, march_step)));
}

}  // namespace nrff
