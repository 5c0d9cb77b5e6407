#include "sfm/scene_pack.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <map>
#include <set>

#include "pipeline/error.h"
#include "pipeline/extension.h"
#include "pipeline/files.h"
#include "pipeline/log.h"
#include "pipeline/scene.h"
#include "sfm/capture.h"
#include "sfm/colmap_model.h"
#include "sfm/distortion.h"
#include "sfm/earlier_frame.h"
#include "sfm/image_pack.h"
#include "sfm/normalise.h"
#include "sfm/sparse_depth.h"
#include "sfm/transforms_json.h"
#include "sfm/undistort.h"
#include "sfm/view_exposure.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;
using Eigen::Vector3d;

struct TargetCamera {
  Lens lens;
  PinholeTarget target;
};

// A photo that has a pose.
struct PosedPhoto {
  const CaptureImage* photo;
  const ColmapImage* image;
  const TargetCamera* camera;
};

std::vector<PosedPhoto> MatchPhotos(const Capture& capture, const ColmapModel& model,
                                    std::vector<std::string>& unregistered) {
  std::map<std::string, const ColmapImage*> by_name;
  for (const auto& [id, image] : model.images) by_name[image.name] = &image;
  std::vector<PosedPhoto> posed;
  for (const CaptureImage& photo : capture.images) {
    const auto found = by_name.find(photo.id);
    if (found == by_name.end()) {
      unregistered.push_back(photo.Name());
      continue;
    }
    posed.push_back({&photo, found->second, nullptr});
    const ColmapCamera& camera = model.cameras.at(found->second->camera_id);
    if (camera.width != photo.info.width || camera.height != photo.info.height) {
      throw InputError(photo.Name() + " is " + std::to_string(photo.info.width) + "×" +
                       std::to_string(photo.info.height) + " px but its camera is for " + std::to_string(camera.width) +
                       "×" + std::to_string(camera.height) + "; run ingest again");
    }
  }
  return posed;
}

void CheckSplit(const std::vector<PosedPhoto>& posed, size_t n_photos) {
  const auto is_train = [](const PosedPhoto& p) { return p.photo->split == Split::kTrain; };
  const auto n_train = std::count_if(posed.begin(), posed.end(), is_train);
  if (n_train < 2) {
    throw InputError("only " + std::to_string(n_train) + " of the training photos (" + std::to_string(posed.size()) +
                     " of all " + std::to_string(n_photos) +
                     ") have a pose, at least 2 are needed; add photos that overlap more");
  }
  if (n_train == std::ptrdiff_t(posed.size())) {
    LogWarning("no held-out photo has a pose: the model can be trained and rendered, but not scored");
  }
}

// What each camera in use becomes; records the decision and its facts.
std::map<uint32_t, TargetCamera> ChooseTargets(const ColmapModel& model, const std::vector<PosedPhoto>& posed,
                                               const PoseOptions& options, ArtifactWriter& artifact) {
  std::map<uint32_t, TargetCamera> cameras;
  double largest_px = 0;
  bool any = false;
  for (const PosedPhoto& p : posed) {
    const uint32_t id = p.image->camera_id;
    if (cameras.count(id) > 0) continue;
    Lens lens(model.cameras.at(id));
    const double displacement_px = LargestDisplacement(lens, options.max_image_size);
    largest_px = std::max(largest_px, displacement_px);
    const bool undistort = options.undistortion.value_or(needs::Undistortion(displacement_px).needed);
    any |= undistort;
    PinholeTarget target =
        undistort ? UndistortedTarget(lens, options.max_image_size) : ScaledTarget(lens, options.max_image_size);
    cameras.emplace(id, TargetCamera{std::move(lens), target});
  }
  Decision decision = needs::Undistortion(largest_px);
  Force(decision, options.undistortion);
  artifact.AddDecision(decision);
  // JSON has no infinity: null where the lens reaches no ray for part of the photo.
  artifact.facts()["largest_displacement_px"] = std::isfinite(largest_px) ? Json(largest_px) : Json();
  artifact.facts()["undistorted"] = any;
  return cameras;
}

NormaliseInput NormalisationInput(const Capture& capture, const ColmapModel& model,
                                  const std::vector<PosedPhoto>& posed) {
  NormaliseInput input;
  input.box = capture.box;
  input.plain_background = capture.background != Background::kNone;
  for (const auto& [id, point] : model.points) input.points.push_back(point.position);
  for (const PosedPhoto& p : posed) {
    input.masked |= p.photo->info.channels == 4 && capture.masks == Masks::kBackground;
    const PinholeTarget& target = p.camera->target;
    input.cameras.push_back({p.photo->Name(), p.image->rotation.conjugate().toRotationMatrix(), p.image->Center(),
                             std::atan(std::min(target.width / target.fx, target.height / target.fy) / 2)});
    for (const ColmapObservation& observation : p.image->observations) {
      const auto point = model.points.find(uint64_t(observation.point_id));
      if (observation.point_id < 0 || point == model.points.end()) continue;
      const Vector3d in_camera = p.image->rotation * point->second.position + p.image->translation;
      if (in_camera.z() > 0) input.depths.push_back(in_camera.norm());
    }
  }
  return input;
}

// The base's frame, where the model is in its world and the frame suits it.
std::optional<EarlierFrame> KeptFrame(const PoseOptions& options, const fs::path& model_dir,
                                      const NormaliseInput& input, const Normalisation& anew,
                                      ArtifactWriter& artifact) {
  const fs::path extension = model_dir.parent_path() / kExtensionFile;
  if (options.base.empty() || !fs::exists(extension)) return {};
  const Json json = ReadJson(extension);
  const std::string where = EscapePath(extension);
  CheckSchemaVersion(json, kExtensionSchemaVersion, where);
  if (!Get<bool>(json, "frame_kept", where)) return {};
  EarlierFrame earlier = ReadEarlierFrame(options.base);
  const Decision decision = DecideFrame(earlier, anew, input.points);
  artifact.AddDecision(decision);
  if (decision.needed) return {};
  return earlier;
}

Mat4 RowMajor(const Eigen::Matrix4d& m) {
  Mat4 result{};
  for (int i = 0; i < 16; ++i) result[size_t(i)] = m(i / 4, i % 4);
  return result;
}

// Rigid: the rotation of scene_from_world without its scale, and the camera's place in the scene.
Mat4 SceneFromCamera(const ColmapImage& image, const Normalisation& n) {
  Eigen::Matrix4d pose = Eigen::Matrix4d::Identity();
  const Eigen::Quaterniond rotation(Eigen::Matrix3d(n.scene_from_world.topLeftCorner<3, 3>() / n.scale));
  pose.topLeftCorner<3, 3>() = (rotation.normalized() * image.rotation.conjugate().normalized()).toRotationMatrix();
  pose.topRightCorner<3, 1>() = (n.scene_from_world * image.Center().homogeneous()).head<3>();
  return RowMajor(pose);
}

Scene MakeScene(const Capture& capture, const std::vector<PosedPhoto>& posed, const Normalisation& n) {
  Scene scene;
  scene.name = capture.name;
  scene.background = capture.background;
  scene.unbounded = n.unbounded;
  for (size_t i = 0; i < 3; ++i) {
    scene.aabb_min[i] = n.aabb_min[Eigen::Index(i)];
    scene.aabb_max[i] = n.aabb_max[Eigen::Index(i)];
  }
  scene.near = n.near;
  scene.far = n.far;
  scene.scene_from_world = RowMajor(n.scene_from_world);
  uint64_t offset = 0;
  for (const PosedPhoto& p : posed) {
    const PinholeTarget& target = p.camera->target;
    View view;
    view.id = p.photo->id;
    view.name = p.photo->Name();
    view.split = p.photo->split;
    view.width = target.width;
    view.height = target.height;
    view.channels = p.photo->info.channels;
    view.masked = view.channels == 4 && capture.masks == Masks::kIgnore;
    view.pack_offset = offset;
    view.fx = target.fx;
    view.fy = target.fy;
    view.cx = target.cx;
    view.cy = target.cy;
    view.scene_from_camera = SceneFromCamera(*p.image, n);
    offset += view.PixelBytes();
    scene.views.push_back(std::move(view));
  }
  return scene;
}

uint64_t PackBytes(const Scene& scene) {
  return scene.views.empty() ? 0 : scene.views.back().pack_offset + scene.views.back().PixelBytes();
}

// The model as the pack shows it: pinhole cameras, observations moved along, images named by their path.
ColmapModel PinholeModel(const ColmapModel& model, const std::vector<PosedPhoto>& posed) {
  ColmapModel pinhole;
  for (const PosedPhoto& p : posed) {
    pinhole.cameras[p.image->camera_id] = p.camera->target.Camera(p.image->camera_id);
    ColmapImage image = *p.image;
    image.name = EscapePath(p.photo->path);
    image.observations.clear();
    for (const ColmapObservation& observation : p.image->observations) {
      const auto point =
          observation.point_id < 0 ? model.points.end() : model.points.find(uint64_t(observation.point_id));
      if (point == model.points.end()) continue;
      const auto px = TargetFromPhoto({observation.x, observation.y}, p.camera->lens, p.camera->target);
      if (!px) continue;
      auto [entry, is_new] = pinhole.points.try_emplace(point->first, point->second);
      if (is_new) entry->second.track.clear();
      entry->second.track.emplace_back(image.id, uint32_t(image.observations.size()));
      image.observations.push_back({px->x(), px->y(), observation.point_id});
    }
    pinhole.images[image.id] = std::move(image);
  }
  return pinhole;
}

// The model without what views show where they do not count.
ColmapModel WithoutMasked(ColmapModel pinhole, const std::map<uint32_t, uint32_t>& view_of_image, const Scene& scene,
                          const ImagePack& pack) {
  for (auto& [id, point] : pinhole.points) {
    std::erase_if(point.track, [&](const auto& element) {
      const View& view = scene.views[view_of_image.at(element.first)];
      if (!view.masked) return false;
      const ColmapObservation& at = pinhole.images.at(element.first).observations[element.second];
      if (!(at.x >= 0 && at.y >= 0 && at.x < view.width && at.y < view.height)) return true;
      return pack.Pixels(view)[4 * (int64_t(at.y) * view.width + int64_t(at.x)) + 3] != 255;
    });
  }
  return pinhole;
}

// Gives the views their colour gains.
void MeasureExposures(const ColmapModel& pinhole, const std::vector<PosedPhoto>& posed,
                      const std::map<uint32_t, uint32_t>& view_of_image, const ImagePack& pack,
                      const std::optional<EarlierFrame>& kept, Scene& scene, Json& facts) {
  std::vector<WrittenExposure> written;
  for (const PosedPhoto& p : posed) {
    const ImageInfo& info = p.photo->info;
    written.push_back({info.exposure_seconds, info.f_number, info.iso});
  }
  const ViewExposures exposures = MeasureViewExposures(pinhole, view_of_image, scene, pack, written);
  for (size_t i = 0; i < scene.views.size(); ++i) scene.views[i].colour_gain = exposures.gain[i];
  if (kept) KeepExposure(*kept, scene);
  facts["exposure_source"] = exposures.source;
  facts["exposure_spread_ev"] = ExposureSpread(scene);
}

void WritePly(const ColmapModel& model, const Eigen::Matrix4d& scene_from_world, const fs::path& file) {
  std::string bytes = "ply\nformat binary_little_endian 1.0\nelement vertex " + std::to_string(model.points.size()) +
                      "\nproperty float x\nproperty float y\nproperty float z\n"
                      "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n";
  for (const auto& [id, point] : model.points) {
    const Eigen::Vector3f position = (scene_from_world * point.position.homogeneous()).head<3>().cast<float>();
    bytes.append(reinterpret_cast<const char*>(position.data()), 3 * sizeof(float));
    bytes.append(reinterpret_cast<const char*>(point.rgb.data()), 3);
  }
  WriteFileAtomically(file, bytes);
}

}  // namespace

void WriteScene(const fs::path& ingest_dir, const fs::path& model_dir, const PoseOptions& options,
                ArtifactWriter& artifact) {
  const Capture capture = LoadCapture(ingest_dir);
  const ColmapModel model = ReadColmapModel(model_dir);
  std::vector<std::string> unregistered;
  std::vector<PosedPhoto> posed = MatchPhotos(capture, model, unregistered);
  CheckSplit(posed, capture.images.size());
  const std::map<uint32_t, TargetCamera> cameras = ChooseTargets(model, posed, options, artifact);
  for (PosedPhoto& p : posed) p.camera = &cameras.at(p.image->camera_id);

  const NormaliseInput input = NormalisationInput(capture, model, posed);
  Normalisation normalisation = Normalise(input, options.contraction);
  artifact.AddDecision(normalisation.contraction);
  const std::optional<EarlierFrame> kept = KeptFrame(options, model_dir, input, normalisation, artifact);
  if (kept) normalisation = InFrame(*kept, normalisation);
  Scene scene = MakeScene(capture, posed, normalisation);

  std::vector<PackEntry> entries;
  for (size_t i = 0; i < posed.size(); ++i) {
    entries.push_back({posed[i].photo, &posed[i].camera->lens, &posed[i].camera->target, scene.views[i].pack_offset});
  }
  WriteImagePack(artifact.dir() / kPackFile, PackBytes(scene), capture, entries, options.n_threads);
  const ColmapModel pinhole = PinholeModel(model, posed);
  std::map<uint32_t, uint32_t> view_of_image;
  for (size_t i = 0; i < posed.size(); ++i) view_of_image[posed[i].image->id] = uint32_t(i);
  const ImagePack pack(artifact.dir());
  MeasureExposures(pinhole, posed, view_of_image, pack, kept, scene, artifact.facts());
  SaveScene(scene, artifact.dir());

  const std::vector<SparseDepth> depths = MeasureSparseDepths(WithoutMasked(pinhole, view_of_image, scene, pack),
                                                              view_of_image, scene, normalisation.scene_from_world);
  SaveSparseDepths(depths, artifact.dir());
  WritePly(model, normalisation.scene_from_world, artifact.dir() / "points.ply");
  fs::create_directories(artifact.dir() / "sparse");
  WriteColmapText(pinhole, artifact.dir() / "sparse");
  WriteTransforms(pinhole, artifact.dir() / "transforms.json");
  for (const char* output : {kSceneFile, kPackFile, kDepthFile, "points.ply", "sparse", "transforms.json"})
    artifact.AddOutput(output);

  Json& facts = artifact.facts();
  facts["n_views_train"] = scene.ViewsOf(Split::kTrain).size();
  facts["n_views_test"] = scene.ViewsOf(Split::kTest).size();
  facts["unregistered"] = unregistered;
  facts["unbounded"] = scene.unbounded;
  int width = 0, height = 0;
  for (const View& view : scene.views) {
    width = std::max(width, view.width);
    height = std::max(height, view.height);
  }
  facts["width"] = width;
  facts["height"] = height;
  facts["n_points"] = model.points.size();
  facts["n_depths"] = depths.size();
  facts["scale"] = normalisation.scale;
  facts["pack_bytes"] = PackBytes(scene);
}

}  // namespace nrff
