// A posed capture: cameras, images and points as COLMAP's sparse models hold them. The one form in which poses travel
// between ingest (poses given), COLMAP and the pose stage.
//
// Poses are world-to-camera (`camera_from_world`), OpenCV axes; the pixel origin is the image's corner, so the centre
// of the first pixel is (0.5, 0.5). Ids are COLMAP's: positive, not contiguous. Double throughout.
#pragma once

#include <Eigen/Geometry>
#include <array>
#include <cstdint>
#include <filesystem>
#include <map>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

namespace nrff {

// COLMAP's camera models, with its numbering (src/base/camera_models.h of 3.8).
enum class CameraModel : int {
  kSimplePinhole = 0,        // f, cx, cy
  kPinhole = 1,              // fx, fy, cx, cy
  kSimpleRadial = 2,         // f, cx, cy, k
  kRadial = 3,               // f, cx, cy, k1, k2
  kOpenCV = 4,               // fx, fy, cx, cy, k1, k2, p1, p2
  kOpenCVFisheye = 5,        // fx, fy, cx, cy, k1, k2, k3, k4
  kFullOpenCV = 6,           // fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6
  kFov = 7,                  // fx, fy, cx, cy, omega
  kSimpleRadialFisheye = 8,  // f, cx, cy, k
  kRadialFisheye = 9,        // f, cx, cy, k1, k2
  kThinPrismFisheye = 10,    // fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, sx1, sy1
};

const char* CameraModelName(CameraModel model);                      // "SIMPLE_PINHOLE", …
std::optional<CameraModel> CameraModelNamed(std::string_view name);  // the reverse; nothing for other names
int CameraModelParamCount(CameraModel model);

struct ColmapCamera {
  uint32_t id = 0;
  CameraModel model = CameraModel::kPinhole;
  int width = 0, height = 0;  // px
  std::vector<double> params;
};

struct ColmapObservation {
  double x = 0, y = 0;    // px
  int64_t point_id = -1;  // -1: no 3D point
};

struct ColmapImage {
  uint32_t id = 0;
  uint32_t camera_id = 0;
  std::string name;
  Eigen::Quaterniond rotation = Eigen::Quaterniond::Identity();  // camera_from_world
  Eigen::Vector3d translation = Eigen::Vector3d::Zero();         // camera_from_world
  std::vector<ColmapObservation> observations;

  Eigen::Vector3d Center() const { return -(rotation.conjugate() * translation); }
};

struct ColmapPoint {
  Eigen::Vector3d position = Eigen::Vector3d::Zero();
  std::array<uint8_t, 3> rgb{};
  double error_px = -1;
  std::vector<std::pair<uint32_t, uint32_t>> track;  // (image id, observation index)
};

struct ColmapModel {
  std::map<uint32_t, ColmapCamera> cameras;
  std::map<uint32_t, ColmapImage> images;
  std::map<uint64_t, ColmapPoint> points;
};

size_t NumObservations(const ColmapModel& model);  // of points

// Reads cameras/images/points3D as .bin, or as .txt where there is no .bin. Every count is checked against the file's
// size before memory is taken. Throws InputError naming the file, the place and what was found: truncated, an unknown
// camera model, a non-finite pose, an image without its camera.
ColmapModel ReadColmapModel(const std::filesystem::path& dir);
void WriteColmapBinary(const ColmapModel& model, const std::filesystem::path& dir);
void WriteColmapText(const ColmapModel& model, const std::filesystem::path& dir);

}  // namespace nrff
