// Depths of sparse points on rays of training views: what SfM already knows of the surfaces.
//
// A point is triangulated anew from its observations in training views alone, as the position X that minimises
//   Σ (f/D)² |(I − d dᵀ)(X − C)|²,  squared px, over the views' centres C, rays d, focal lengths f and distances D,
// and its distance from one of them has the variance e² vᵀ A⁻¹ v with A = Σ (f/D)² (I − d dᵀ), the residual e per
// degree of freedom, and v the direction to the point: each view fixes it across its ray. What held-out views say of
// points reaches training only by way of the poses, which SfM estimates from all photos.
#pragma once

#include <Eigen/Core>
#include <map>
#include <vector>

#include "pipeline/scene.h"
#include "sfm/colmap_model.h"

namespace nrff {

// `model`: pinhole cameras, observations in px of the scene's views; `view_of_image`: COLMAP image id → index into
// scene.views. Left out: points that fewer than two training views see, and what is behind a view, not finite, or
// uncertain by more than 5 % of its distance. In order of points, then views.
std::vector<SparseDepth> MeasureSparseDepths(const ColmapModel& model,
                                             const std::map<uint32_t, uint32_t>& view_of_image, const Scene& scene,
                                             const Eigen::Matrix4d& scene_from_world);

}  // namespace nrff
