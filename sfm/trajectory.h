// Camera trajectories, to be compared with each other: what poses are called, where they are, where they look.
#pragma once

#include <Eigen/Geometry>
#include <filesystem>
#include <string>
#include <vector>

namespace nrff {

struct TrajectoryPose {
  // Of the photo: its path without extension. Where photos' names are not known, "#" and a number, which is no photo's:
  // the first number of a .log's pose, the id in artifacts of ingest and sfm.
  std::string name;
  Eigen::Quaterniond rotation;  // world_from_camera, OpenCV axes
  Eigen::Vector3d center;       // world units
};
using Trajectory = std::vector<TrajectoryPose>;  // by name

// Reads what is at `path`:
//   a .log file as Tanks & Temples has them: blocks of three whole numbers and a 4×4 world_from_camera
//   a train artifact whose cameras were corrected: these, of the training views
//   a workspace, another artifact or a folder with a COLMAP model: that model
//   a folder of .txt files with a 4×4 world_from_camera each, as NSVF's pose/: where its 3×3 part is no rotation to
//   1e-3, as in data sets of perturbed poses, the nearest one (to a tenth)
//   a capture with poses (transforms.json, NSVF, COLMAP)
// Throws InputError naming the file, the line and what was found: cut short, not finite, no rotation.
Trajectory ReadTrajectory(const std::filesystem::path& path);

void WriteTrajectoryLog(const Trajectory& trajectory, const std::filesystem::path& file);

// A 4×4 similarity as Tanks & Temples' trans.txt has it. Throws InputError unless it is one, to 1e-3.
Eigen::Matrix4d ReadSimilarity(const std::filesystem::path& file);

// Every pose moved by a similarity of the world.
Trajectory Transformed(const Trajectory& trajectory, const Eigen::Matrix4d& similarity);

}  // namespace nrff
