// The volume that a Tanks & Temples scene is evaluated in (SCENE.json): a polygon swept along an axis.
#pragma once

#include <Eigen/Core>
#include <filesystem>
#include <vector>

namespace nrff {

struct CropVolume {
  int axis = 2;                          // that the polygon is swept along: x = 0, y = 1, z = 2
  double least = 0, most = 0;            // along it
  std::vector<Eigen::Vector3d> polygon;  // the coordinate along the axis means nothing

  // The polygon's corners at both ends.
  std::vector<Eigen::Vector3d> Corners() const;
};

// Open3D's SelectionPolygonVolume: {"class_name", "orthogonal_axis": "X" | "Y" | "Z", "axis_min", "axis_max",
// "bounding_polygon": [[x, y, z], …]}. Throws InputError naming the file and what cannot be.
CropVolume ReadCropVolume(const std::filesystem::path& file);

}  // namespace nrff
