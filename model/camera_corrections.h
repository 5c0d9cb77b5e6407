// Small corrections of a scene's cameras, found while a model is trained (camera_update.h).
//
// A correction moves a camera in its own axes, T' = T·[R(turn) | shift], and changes focal length and principal point,
// which views of equal intrinsics share: f' = f·exp(log_focal), c' = c + shift.
#pragma once

#include <string>
#include <tuple>
#include <vector>

#include "pipeline/json.h"
#include "pipeline/scene.h"

namespace nrff {

struct PoseCorrection {
  std::string view;  // its id
  Vec3 turn{};       // radians, a rotation vector in the camera's axes
  Vec3 shift{};      // scene units, in the camera's axes

  // Followed by another correction, in the axes of the camera as it is corrected.
  void Append(const Vec3& further_turn, const Vec3& further_shift);
};

struct IntrinsicsCorrection {
  int width = 0, height = 0;              // px, of the views that have
  double fx = 0, fy = 0, cx = 0, cy = 0;  // these intrinsics
  double log_focal = 0;
  double shift_x = 0, shift_y = 0;  // px, of the principal point

  auto Given() const { return std::tie(width, height, fx, fy, cx, cy); }
};

struct CameraCorrections {
  std::vector<PoseCorrection> poses;             // of the training views
  std::vector<IntrinsicsCorrection> intrinsics;  // of every kind there is among them

  // Those that change nothing.
  static CameraCorrections None(const std::vector<View>& training);
  // Of these training views: those that are known, none of the others.
  CameraCorrections Of(const std::vector<View>& training) const;
  // Place of the view's intrinsics among those that are known; their number where they are not.
  size_t KindOf(const View& view) const;
  // A view of the scene as it is corrected: its pose where it is a training view, its intrinsics where training views
  // have the same.
  View Corrected(View view) const;
};

void to_json(Json& json, const CameraCorrections& corrections);
// Throws when a key is missing, of another type, or a number is not finite.
void from_json(const Json& json, CameraCorrections& corrections);

// JSON of the corrected cameras of all views: {"schema_version", "views": [{"id", "name", "split", "width", "height",
// "fx", "fy", "cx", "cy", "scene_from_camera": 16, row-major, "displacement_px": of training views}]}.
Json CorrectedCamerasJson(const Scene& scene, const CameraCorrections& corrections,
                          const std::vector<double>& displacement_px);
inline constexpr char kCamerasFile[] = "cameras.json";
inline constexpr int kCamerasSchemaVersion = 1;

}  // namespace nrff
