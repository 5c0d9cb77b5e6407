// The frame of a scene made of fewer of the photos, which one made of all of them keeps where it suits them.
#pragma once

#include <filesystem>
#include <map>
#include <string>

#include "pipeline/scene.h"
#include "sfm/normalise.h"

namespace nrff {

struct EarlierFrame {
  Eigen::Matrix4d scene_from_world;
  bool unbounded = false;
  Eigen::Vector3d aabb_min, aabb_max;  // scene units
  double near = 0, far = 0;
  std::map<std::string, Vec3> training_gains;  // colour gains of training views, by id
};

// Reads `dir`/scene.json, without its pack. Throws CorruptError naming the file and what is wrong with it.
EarlierFrame ReadEarlierFrame(const std::filesystem::path& dir);

// Whether the frame suits what Normalise chose for all photos; `points`: world units.
Decision DecideFrame(const EarlierFrame& earlier, const Normalisation& anew,
                     const std::vector<Eigen::Vector3d>& points);

// The earlier frame, with a range of depths that holds those of both.
Normalisation InFrame(const EarlierFrame& earlier, const Normalisation& anew);

// Makes colour gains refer to the exposure that those of the earlier scene refer to: the geometric mean of the ratios
// over the training views that both have becomes 1.
void KeepExposure(const EarlierFrame& earlier, Scene& scene);

}  // namespace nrff
