// transforms.json: poses and intrinsics as NeRF-synthetic, instant-ngp and nerfstudio write them.
//
// Poses in the file are camera-to-world with OpenGL axes (x right, y up, z backward); here they become OpenCV's.
//   NeRF-synthetic  camera_angle_x only; file_path without extension; transforms_train.json, transforms_test.json
//   instant-ngp     fl_x fl_y cx cy w h k1 k2 p1 p2 (k1…k4 with is_fisheye), aabb_scale; angles where fl_x lacks
//   nerfstudio      intrinsics and camera_model per file or per frame; train_filenames, test_filenames; poses were
//                   multiplied by applied_transform, then moved by the factor applied_scale: both are undone here, so
//                   that the world frame is the one of the data the poses came from
// Python's NaN and Infinity, which are not JSON, are understood so far that the error can name the frame.
#pragma once

#include <Eigen/Core>
#include <filesystem>
#include <optional>

#include "sfm/colmap_model.h"
#include "sfm/source.h"

namespace nrff {

// The source for the transforms files at the top of `root`; nothing where there is none. Frames whose photo does not
// exist are rejected by name. Throws InputError naming file and frame.
std::optional<Source> ReadTransformsSource(const std::filesystem::path& root);

// Writes the model's cameras and poses in nerfstudio's form. Image names become file_path and must be valid UTF-8.
// `applied_transform` (rigid, 3×4) and `applied_scale` lead from the model's world frame to the file's. Throws
// InputError for a camera model that the format cannot hold.
void WriteTransforms(const ColmapModel& model, const std::filesystem::path& file,
                     const Eigen::Matrix<double, 3, 4>& applied_transform = Eigen::Matrix<double, 3, 4>::Identity(),
                     double applied_scale = 1);

}  // namespace nrff
