// Camera paths: a sequence of pinhole views to render a film from.
//
// Paths are made in scene space, where +z is up and the capture's subject is near the origin (the pose stage's
// normalisation). Frames' ids are "000000", "000001", …; they belong to no split that is scored.
#pragma once

#include <filesystem>
#include <vector>

#include "pipeline/scene.h"

namespace nrff {

struct PathOptions {
  int n_frames = 120;
  int width = 0, height = 0;  // px; 0: as the first training view
};

// Where the training cameras look: the point nearest to all their optical axes in the least-squares sense, kept
// inside the scene's box. The box's centre where the axes are parallel.
Vec3 FocusPoint(const Scene& scene);

// A full turn around the vertical line through the focus point, at the training cameras' median horizontal distance
// and median height, looking at the focus point.
std::vector<View> OrbitPath(const Scene& scene, const PathOptions& options);

// Two turns of an ellipse about the cameras' median position, looking at the focus point: for captures that see their
// subject from one side. Its half axes are half the cameras' median distances from that position, along the view's
// right, down and forward axes.
std::vector<View> SpiralPath(const Scene& scene, const PathOptions& options);

// A JSON file in one of two forms:
//   [{"scene_from_camera": [16 numbers, row-major]}, …]         OpenCV axes, intrinsics of the first training view
//   {"camera_path": [{"camera_to_world": [16], "fov": degrees}, …], "render_width": w, "render_height": h}
//       nerfstudio's: OpenGL axes, the capture's world frame, fov vertical; width and height are optional
// `options.n_frames` is not used. Throws InputError naming the file, the frame and what was found.
std::vector<View> ReadPath(const std::filesystem::path& file, const Scene& scene, const PathOptions& options);

}  // namespace nrff
