#include "sfm/colmap_model.h"

#include <cmath>
#include <iterator>
#include <utility>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "sfm/colmap_io.h"

namespace nrff {
namespace {

struct ModelInfo {
  const char* name;
  int n_params;
};

// In the order of CameraModel.
constexpr ModelInfo kModels[] = {
    {"SIMPLE_PINHOLE", 3},
    {"PINHOLE", 4},
    {"SIMPLE_RADIAL", 4},
    {"RADIAL", 5},
    {"OPENCV", 8},
    {"OPENCV_FISHEYE", 8},
    {"FULL_OPENCV", 12},
    {"FOV", 5},
    {"SIMPLE_RADIAL_FISHEYE", 4},
    {"RADIAL_FISHEYE", 5},
    {"THIN_PRISM_FISHEYE", 12},
};

constexpr int kMaxImageSide_px = 1 << 20;

// What holds between the files: every image has its camera, every track leads to an observation.
void CheckReferences(const ColmapModel& model, const std::filesystem::path& dir) {
  for (const auto& [id, image] : model.images) {
    if (!model.cameras.contains(image.camera_id)) {
      throw InputError(EscapePath(dir) + ": image " + EscapePath(image.name) + " (id " + std::to_string(id) +
                       ") has camera " + std::to_string(image.camera_id) +
                       ", which the cameras file does not hold; export the model again");
    }
  }
  for (const auto& [id, point] : model.points) {
    for (const auto& [image_id, index] : point.track) {
      auto image = model.images.find(image_id);
      if (image == model.images.end() || index >= image->second.observations.size()) {
        throw InputError(EscapePath(dir) + ": the track of point " + std::to_string(id) + " names observation " +
                         std::to_string(index) + " of image " + std::to_string(image_id) +
                         ", which the images file does not hold; export the model again");
      }
    }
  }
}

}  // namespace

const char* CameraModelName(CameraModel model) { return kModels[static_cast<int>(model)].name; }

std::optional<CameraModel> CameraModelNamed(std::string_view name) {
  for (size_t i = 0; i < std::size(kModels); ++i) {
    if (name == kModels[i].name) return CameraModel(int(i));
  }
  return {};
}

int CameraModelParamCount(CameraModel model) { return kModels[static_cast<int>(model)].n_params; }

void AddCamera(ColmapModel& model, ColmapCamera camera, const std::string& where) {
  if (camera.width <= 0 || camera.height <= 0 || camera.width > kMaxImageSide_px || camera.height > kMaxImageSide_px) {
    throw InputError(where + ": camera " + std::to_string(camera.id) + " has the size " + std::to_string(camera.width) +
                     "×" + std::to_string(camera.height) + " px; the file is damaged, export the model again");
  }
  for (double param : camera.params) {
    if (!std::isfinite(param)) {
      throw InputError(where + ": camera " + std::to_string(camera.id) +
                       " has a parameter that is not a finite number");
    }
  }
  const uint32_t id = camera.id;
  if (!model.cameras.emplace(id, std::move(camera)).second) {
    throw InputError(where + ": camera id " + std::to_string(id) + " occurs twice");
  }
}

void AddImage(ColmapModel& model, ColmapImage image, const std::string& where) {
  if (image.name.empty() || image.name.find('\0') != std::string::npos) {
    throw InputError(where + ": the name of image " + std::to_string(image.id) + ", \"" + EscapePath(image.name) +
                     "\", is no file's; the file is damaged, export the model again");
  }
  const double norm = image.rotation.norm();
  if (!std::isfinite(norm) || norm < 1e-6 || !image.translation.allFinite()) {
    throw InputError(where + ": the pose of image " + EscapePath(image.name) +
                     " is not a finite rotation and translation");
  }
  image.rotation.normalize();
  const uint32_t id = image.id;
  if (!model.images.emplace(id, std::move(image)).second) {
    throw InputError(where + ": image id " + std::to_string(id) + " occurs twice");
  }
}

void AddPoint(ColmapModel& model, uint64_t id, ColmapPoint point, const std::string& where) {
  if (!point.position.allFinite()) {
    throw InputError(where + ": the position of point " + std::to_string(id) + " is not finite");
  }
  if (!model.points.emplace(id, std::move(point)).second) {
    throw InputError(where + ": point id " + std::to_string(id) + " occurs twice");
  }
}

size_t NumObservations(const ColmapModel& model) {
  size_t n = 0;
  for (const auto& [id, point] : model.points) n += point.track.size();
  return n;
}

ColmapModel ReadColmapModel(const std::filesystem::path& dir) {
  ColmapModel model;
  if (std::filesystem::exists(dir / "cameras.bin")) {
    model = ReadColmapBinary(dir);
  } else if (std::filesystem::exists(dir / "cameras.txt")) {
    model = ReadColmapText(dir);
  } else {
    throw InputError(EscapePath(dir) +
                     ": holds no COLMAP model; expected cameras, images and points3D as .bin or .txt");
  }
  CheckReferences(model, dir);
  return model;
}

}  // namespace nrff
