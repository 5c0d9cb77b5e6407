// How a model of all photos compares with the model of the earlier ones that it extends.
#pragma once

#include <Eigen/Core>
#include <optional>

#include "pipeline/extension.h"
#include "sfm/colmap_model.h"

namespace nrff {

// Two worlds laid over each other by the cameras that both models have (AlignTrajectories), and what is left between
// them: for every such camera the distances, in px, between where it sees its points in the earlier model and where the
// points of the earlier model, moved along, are seen by the camera as it is now.
struct WorldShift {
  Eigen::Matrix4d earlier_from_now;      // similarity
  double median_px = 0, largest_px = 0;  // over cameras, of their median distances
};

// Nothing with fewer than three common cameras that see points, or where these do not say how to lay the worlds.
std::optional<WorldShift> MeasureShift(const ColmapModel& earlier, const ColmapModel& now);

// The model in another world. `similarity`: other_from_world.
ColmapModel Transformed(const ColmapModel& model, const Eigen::Matrix4d& similarity);

// Mean reprojection error over points, px; 0 without points.
double MeanError(const ColmapModel& model);

}  // namespace nrff
