#include "sfm/crop_volume.h"

#include <cmath>
#include <string>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"

namespace nrff {

std::vector<Eigen::Vector3d> CropVolume::Corners() const {
  std::vector<Eigen::Vector3d> corners;
  for (const double end : {least, most}) {
    for (Eigen::Vector3d corner : polygon) {
      corner[axis] = end;
      corners.push_back(corner);
    }
  }
  return corners;
}

CropVolume ReadCropVolume(const std::filesystem::path& file) {
  const std::string where = EscapePath(file);
  const auto refuse = [&](const std::string& what) {
    return InputError(where + ": " + what + "; expected a crop volume as Tanks & Temples has them (SCENE.json)");
  };
  Json json;
  try {
    json = ParseJson(ReadFile(file));
  } catch (const JsonSyntaxError& error) {
    throw refuse(std::string("it is no JSON (") + error.what() + ")");
  }
  if (!json.is_object() || !json.contains("class_name") || json.at("class_name") != "SelectionPolygonVolume")
    throw refuse("it is no SelectionPolygonVolume");
  CropVolume volume;
  try {
    const auto axis = json.at("orthogonal_axis").get<std::string>();
    const size_t known = axis.size() == 1 ? std::string("XYZxyz").find(axis) : std::string::npos;
    if (known == std::string::npos) throw refuse("orthogonal_axis is '" + axis + "'");
    volume.axis = int(known % 3);
    volume.least = json.at("axis_min").get<double>();
    volume.most = json.at("axis_max").get<double>();
    for (const auto& corner : json.at("bounding_polygon").get<std::vector<std::vector<double>>>()) {
      if (corner.size() != 3)
        throw refuse("a corner of bounding_polygon has " + std::to_string(corner.size()) + " numbers");
      volume.polygon.emplace_back(corner[0], corner[1], corner[2]);
    }
  } catch (const Json::exception& error) {
    throw refuse(std::string("orthogonal_axis, axis_min, axis_max or bounding_polygon is not as expected (") +
                 error.what() + ")");
  }
  if (!(volume.least < volume.most)) throw refuse("axis_min is not less than axis_max");
  if (volume.polygon.size() < 3) throw refuse("bounding_polygon has fewer than three corners");
  for (const Eigen::Vector3d& corner : volume.Corners()) {
    if (!corner.allFinite()) throw refuse("a corner is not finite");
  }
  return volume;
}

}  // namespace nrff
