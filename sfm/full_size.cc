#include "sfm/full_size.h"

#include <algorithm>
#include <map>
#include <set>
#include <string>
#include <utility>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "sfm/sensor_frame.h"
#include "sfm/source.h"
#include "sfm/working_photos.h"

namespace nrff {
namespace {

std::map<std::string, const ImageInfo*> InfosById(const Capture& capture) {
  std::map<std::string, const ImageInfo*> infos;
  for (const CaptureImage& photo : capture.images) infos[photo.id] = &photo.info;
  return infos;
}

}  // namespace

ColmapModel AtFullSize(const ColmapModel& working, const Capture& capture) {
  const std::map<std::string, const ImageInfo*> infos = InfosById(capture);
  ColmapModel model = working;
  std::map<uint32_t, double> scale_by_image;  // photo px per working px
  for (auto& [id, image] : model.images) {
    image.name = IdOfWorkingPhoto(image.name);
    const auto info = infos.find(image.name);
    if (info == infos.end())
      throw CorruptError("COLMAP's model holds an image " + EscapePath(image.name) +
                         " that is not of this capture; remove the partial artifact and run again");
    const ColmapCamera& camera = working.cameras.at(image.camera_id);
    const auto [width, height] = SensorSize(*info->second);
    if ((camera.width > camera.height) != (width > height) && camera.width != camera.height)
      throw CorruptError("COLMAP's model has photo " + EscapePath(image.name) + " " + std::to_string(camera.width) +
                         "×" + std::to_string(camera.height) + ", its sensor " + std::to_string(width) + "×" +
                         std::to_string(height) + "; remove the partial artifact and run again");
    model.cameras[image.camera_id] = ScaledCamera(camera, width, height);
    const double scale_x = double(width) / camera.width, scale_y = double(height) / camera.height;
    scale_by_image[id] = (scale_x + scale_y) / 2;
    for (ColmapObservation& observation : image.observations) {
      observation.x *= scale_x;
      observation.y *= scale_y;
    }
  }
  for (auto& [id, point] : model.points) {
    if (!point.track.empty()) point.error_px *= scale_by_image.at(point.track.front().first);
  }
  return model;
}

ColmapModel AsDisplayed(const ColmapModel& full_size, const Capture& capture) {
  const std::map<std::string, const ImageInfo*> infos = InfosById(capture);
  ColmapModel model = full_size;
  std::map<std::pair<uint32_t, int>, uint32_t> turned_cameras;  // by camera and quarter turns
  for (auto& [id, image] : model.images) {
    const int turns = QuarterTurns(infos.at(image.name)->orientation);
    if (turns == 0) continue;
    const ColmapCamera& camera = full_size.cameras.at(image.camera_id);
    const uint32_t next_id = model.cameras.rbegin()->first + 1;
    image.camera_id = turned_cameras.emplace(std::pair(camera.id, turns), next_id).first->second;
    ColmapCamera turned = TurnedCamera(camera, turns);
    turned.id = image.camera_id;
    model.cameras[image.camera_id] = std::move(turned);
    TurnImage(image, camera.width, camera.height, turns);
  }
  std::set<uint32_t> used;
  for (const auto& [id, image] : model.images) used.insert(image.camera_id);
  std::erase_if(model.cameras, [&](const auto& camera) { return !used.contains(camera.first); });
  return model;
}

}  // namespace nrff
