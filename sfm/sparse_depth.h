// Depths of sparse points on rays of training views: what SfM already knows of the surfaces.
//
// A point's position has the covariance A⁻¹ e², A = Σ (f/D)² (I − d dᵀ) over the training views that see it, with its
// reprojection error e (px), the views' focal lengths f (px), and its distance D and direction d from them: each view
// fixes it across its ray. Held-out views tell training nothing: points are taken as the training views alone fix them.
#pragma once

#include <Eigen/Core>
#include <vector>

#include "pipeline/scene.h"
#include "sfm/colmap_model.h"

namespace nrff {

// `model`: its images' ids and its points' tracks are used; `view_of_image`: COLMAP image id → index into scene.views;
// `error_scale`: view px per px of the points' errors, by view. Points that fewer than two training views see, or whose
// distance is uncertain by more than 5 %, are left out. In order of points, then views.
std::vector<SparseDepth> MeasureSparseDepths(const ColmapModel& model,
                                             const std::map<uint32_t, uint32_t>& view_of_image,
                                             const std::vector<double>& error_scale, const Scene& scene,
                                             const Eigen::Matrix4d& scene_from_world);

}  // namespace nrff
