// Normalisation: the similarity scene_from_world and the box that training works in, from cameras and points.
//
// Scene frame: +z up; the box's largest half-extent is 1 and its centre the origin. Three kinds of capture:
//   box given      the box as given, not rotated; bounded
//   inward-looking the optical axes meet at a focus point in front of the cameras: it becomes the centre
//   outward or forward-looking (also: one camera, all cameras at one place): the centre lies on the mean optical axis
//   at
//                  the median depth of the points
// Inward-looking captures are bounded when the photos show nothing but the object (masked, or on a plain background
// with hardly a point beyond what all cameras see): the box then holds the points. Otherwise the box is the foreground,
// the rest is contracted. Points alone do not tell: sky and other smooth surroundings have none.
//
// The result is the same scene for any similarity of the input world, box-given captures aside. Medians and quantiles
// throughout, so that a few bad cameras or points change little.
#pragma once

#include <Eigen/Geometry>
#include <array>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/needs.h"
#include "pipeline/scene.h"

namespace nrff {

struct PosedCamera {
  std::string name;                   // for errors
  Eigen::Matrix3d world_from_camera;  // rotation, OpenCV axes
  Eigen::Vector3d center;             // world units
  double half_field = 0.5;            // half the angle of view along the image's shorter side, radians
};

struct NormaliseInput {
  std::vector<PosedCamera> cameras;          // in order of their ids
  std::vector<Eigen::Vector3d> points;       // world units; may be empty
  std::vector<double> depths;                // of the points from the cameras that see them, along the ray, world units
  std::optional<std::array<double, 6>> box;  // min xyz, max xyz, world units
  bool masked = false;                       // the photos have alpha
  bool plain_background = false;             // a known colour is behind the object
};

struct Normalisation {
  Eigen::Matrix4d scene_from_world = Eigen::Matrix4d::Identity();  // scale·rotation, translation
  double scale = 1;                                                // scene units per world unit
  bool unbounded = true;
  Eigen::Vector3d aabb_min = -Eigen::Vector3d::Ones(), aabb_max = Eigen::Vector3d::Ones();  // scene units
  double near = 0, far = 0;  // along the ray, scene units
  Decision contraction;
};

// `force_contraction` overrides what the capture suggests. Throws InputError when there is no camera, a value is not
// finite, or the box is empty.
Normalisation Normalise(const NormaliseInput& input, std::optional<bool> force_contraction = {});

// Building blocks, for tests.

// Unit vector nearest to orthogonal to the cameras' x axes, on the side of their −y axes: what stands upright in the
// photos, however far the cameras look down.
Eigen::Vector3d UpDirection(const std::vector<PosedCamera>& cameras);

// Point nearest to all optical axes, by least absolute distances (iteratively reweighted). Nothing when the axes are
// too parallel to tell, or the point is not in front of most cameras.
std::optional<Eigen::Vector3d> FocusPoint(const std::vector<PosedCamera>& cameras);

}  // namespace nrff
