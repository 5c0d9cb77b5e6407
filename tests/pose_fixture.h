// A small capture with known cameras, for tests of the pose stages: photos on disk, capture.json, a COLMAP model.
#pragma once

#include <OpenImageIO/imageio.h>

#include <Eigen/Geometry>
#include <cmath>
#include <filesystem>
#include <random>
#include <string>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"
#include "pipeline/manifest.h"
#include "sfm/capture.h"
#include "sfm/colmap_model.h"

namespace nrff {

inline void WritePng(const Image& image, const std::filesystem::path& file) {
  const auto output = OIIO::ImageOutput::create("png");
  output->open(file.native(), OIIO::ImageSpec(image.width, image.height, image.channels, OIIO::TypeDesc::UINT8));
  output->write_image(OIIO::TypeDesc::UINT8, image.pixels.data());
  output->close();
}

inline std::string Id(int i) {
  char text[16];
  std::snprintf(text, sizeof text, "%06d", i);
  return text;
}

// `n` photos of noise, 64×48; every third is held out.
inline Capture MakeCapture(const std::filesystem::path& root, int n, bool posed) {
  std::filesystem::create_directories(root);
  Capture capture;
  capture.name = "synthetic";
  capture.kind = posed ? "colmap" : "photos";
  capture.root = root;
  capture.split_rule = "every 3rd";
  capture.posed = posed;
  capture.ordered = true;
  std::mt19937 random(11);
  for (int i = 0; i < n; ++i) {
    Image image{64, 48, 3, std::vector<uint8_t>(64 * 48 * 3)};
    for (uint8_t& value : image.pixels) value = uint8_t(random());
    CaptureImage photo;
    photo.id = Id(i);
    photo.path = "photo " + std::to_string(i) + ".png";
    photo.split = i % 3 == 0 ? Split::kTest : Split::kTrain;
    photo.info.width = image.width;
    photo.info.height = image.height;
    WritePng(image, root / photo.path);
    photo.hash = HashFile(root / photo.path);
    capture.images.push_back(photo);
  }
  return capture;
}

// Cameras on a ring of radius 4 looking at the origin, with a cloud of points around it that all of them see.
// `width` × `height`: of the images the model is for; `names`: in order.
inline ColmapModel MakeModel(const std::vector<std::string>& names, int width, int height, double k) {
  ColmapModel model;
  model.cameras[3] = {3, CameraModel::kSimpleRadial, width, height, {1.2 * width, width / 2.0, height / 2.0, k}};
  std::mt19937 random(5);
  std::uniform_real_distribution<double> coordinate(-1, 1);
  for (uint64_t i = 0; i < 40; ++i) {
    ColmapPoint point;
    point.position = {coordinate(random), coordinate(random), coordinate(random)};
    point.rgb = {uint8_t(i), 100, 200};
    point.error_px = 0.5;
    model.points[100 + i] = point;
  }
  for (size_t i = 0; i < names.size(); ++i) {
    const double angle = 2 * M_PI * double(i) / double(names.size());
    const Eigen::Vector3d center(4 * std::cos(angle), 4 * std::sin(angle), 1 + 0.3 * double(i % 2));
    Eigen::Matrix3d world_from_camera;
    const Eigen::Vector3d z = -center.normalized(), x = z.cross(Eigen::Vector3d::UnitZ()).normalized();
    world_from_camera << x, z.cross(x), z;
    ColmapImage image;
    image.id = uint32_t(10 + i);
    image.camera_id = 3;
    image.name = names[i];
    image.rotation = Eigen::Quaterniond(Eigen::Matrix3d(world_from_camera.transpose()));
    image.translation = -(image.rotation * center);
    for (auto& [id, point] : model.points) {
      const Eigen::Vector3d p = image.rotation * point.position + image.translation;
      const Eigen::Vector2d uv = p.head<2>() / p.z();
      const Eigen::Vector2d px = 1.2 * width * uv * (1 + k * uv.squaredNorm()) + Eigen::Vector2d(width, height) / 2;
      point.track.emplace_back(image.id, uint32_t(image.observations.size()));
      image.observations.push_back({px.x(), px.y(), int64_t(id)});
    }
    model.images[image.id] = image;
  }
  return model;
}

}  // namespace nrff
