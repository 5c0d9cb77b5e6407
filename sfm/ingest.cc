#include "sfm/ingest.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <map>
#include <set>
#include <string>
#include <system_error>
#include <tuple>
#include <utility>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/log.h"
#include "pipeline/needs.h"
#include "sfm/added_photos.h"
#include "sfm/capture.h"
#include "sfm/image_measures.h"
#include "sfm/ingest_facts.h"
#include "sfm/masks.h"
#include "sfm/photo_work.h"
#include "sfm/recognise.h"
#include "sfm/sensor_frame.h"
#include "sfm/video.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr int kMinSide_px = 16;  // below, there is nothing to reconstruct from

struct MeasuredPhoto {
  CaptureImage image;
  std::optional<Split> given_split;
  DifferenceHash look;
  FrameShares frame;
  std::optional<RejectedFile> rejected;
  std::string video;  // that it is a frame of
};

// The folder's path and name as recorded: absolute, without "." and a slash at the end.
fs::path CapturePath(const fs::path& given) {
  const fs::path path = fs::absolute(given).lexically_normal();
  return path.has_filename() ? path : path.parent_path();
}

// Whether a photo can be a resized copy of what a camera of that size took: the same shape up to rounding.
bool Fits(const ColmapCamera& camera, int width, int height) {
  const double expected_height = static_cast<double>(camera.height) * width / camera.width;
  return std::abs(expected_height - height) <= 1 + 0.005 * height;
}

// Makes `info` say how the photo is to be turned so that its pose fits it. False where neither way does.
bool FitOrientation(const ColmapCamera& camera, bool poses_ignore_orientation, ImageInfo& info) {
  if (!poses_ignore_orientation && Fits(camera, info.width, info.height)) return true;
  if (info.orientation >= 5) std::swap(info.width, info.height);
  info.orientation = 1;
  return Fits(camera, info.width, info.height);
}

void Measure(const Source& source, const fs::path& artifact, const ColmapCamera* camera, MeasuredPhoto& photo) {
  CaptureImage& image = photo.image;
  const fs::path file = (image.extracted ? artifact : source.root) / image.path;
  auto reject = [&](const std::string& reason) { photo.rejected = RejectedFile{EscapePath(image.path), reason}; };
  try {
    image.info = ProbeImage(file);
    ImageInfo& info = image.info;
    if (info.width < kMinSide_px || info.height < kMinSide_px) {
      return reject("is " + std::to_string(info.width) + "×" + std::to_string(info.height) +
                    " px; at least 16×16 are needed");
    }
    if (camera && !FitOrientation(*camera, source.poses_ignore_orientation, info)) {
      return reject("is " + std::to_string(info.width) + "×" + std::to_string(info.height) +
                    " px, but its camera is for " + std::to_string(camera->width) + "×" +
                    std::to_string(camera->height) + " px");
    }
    image.hash = HashFile(file);
    Image pixels = ReadImageOriented(file, info.orientation);
    if (!image.mask.empty()) {
      ApplyMask(source.root / image.mask, info.orientation, pixels);
      image.mask_hash = HashFile(source.root / image.mask);
    }
    info.channels = pixels.channels;
    if (image.extracted) info.model = photo.video;  // frames of a video share a camera with no other photos
    image.blur = MeasureBlur(pixels);
    photo.look = HashDifferences(pixels);
    photo.frame = MeasureFrame(pixels);
  } catch (const Error& error) {
    photo.rejected = Rejection(image.extracted ? artifact : source.root, image.path, error);
  }
}

// The camera of each posed path.
std::map<std::string, const ColmapCamera*> CamerasByPath(const Source& source) {
  std::map<std::string, const ColmapCamera*> cameras;
  if (!source.model) return cameras;
  for (const auto& [id, image] : source.model->images)
    cameras.emplace(image.name, &source.model->cameras.at(image.camera_id));
  return cameras;
}

std::vector<MeasuredPhoto> MeasureAll(const Source& source, const fs::path& artifact, int n_threads) {
  const auto cameras = CamerasByPath(source);
  std::vector<MeasuredPhoto> photos(source.images.size());
  ForEachPhoto("reading photos", photos.size(), n_threads, [&](size_t i) {
    photos[i].image.path = source.images[i].path;
    photos[i].image.mask = source.images[i].mask;
    photos[i].image.extracted = source.images[i].extracted;
    photos[i].video = source.images[i].video;
    photos[i].given_split = source.images[i].split;
    const auto camera = cameras.find(source.images[i].path.native());
    Measure(source, artifact, camera == cameras.end() ? nullptr : camera->second, photos[i]);
  });
  return photos;
}

void RejectCopies(std::vector<MeasuredPhoto>& photos) {
  std::map<std::string, const MeasuredPhoto*> first_with_hash;
  for (MeasuredPhoto& photo : photos) {
    if (photo.rejected) continue;
    const auto [first, is_new] = first_with_hash.emplace(photo.image.hash, &photo);
    if (!is_new)
      photo.rejected =
          RejectedFile{EscapePath(photo.image.path), "has the same bytes as " + EscapePath(first->second->image.path)};
  }
}

// Decides who is held out, and the name of the rule. The data set's own split counts if both sides are left.
std::string FreezeHoldOut(const std::vector<std::optional<Split>>& given, std::vector<Split>& splits) {
  auto has = [&](Split split) { return std::find(given.begin(), given.end(), split) != given.end(); };
  const bool all_given = std::all_of(given.begin(), given.end(), [](const auto& split) { return split.has_value(); });
  const bool own = all_given && has(Split::kTrain) && has(Split::kTest);
  splits.clear();
  for (size_t i = 0; i < given.size(); ++i) {
    splits.push_back(own ? *given[i] : i % kHoldOutEvery == 0 ? Split::kTest : Split::kTrain);
  }
  return own ? "the data set's own" : "every 8th by file name";
}

void CheckEnough(const Source& source, size_t n_usable, const std::vector<RejectedFile>& rejected) {
  if (n_usable >= static_cast<size_t>(kMinImages)) return;
  std::string message = EscapePath(source.given) + ": ";
  if (n_usable == 1 && rejected.empty()) {
    message += "holds one photo, and one photo cannot be reconstructed";
  } else {
    message += std::to_string(n_usable) + " of " + std::to_string(n_usable + rejected.size()) + " photos can be used";
    if (!rejected.empty()) message += " (" + rejected.front().name + " " + rejected.front().reason + ")";
  }
  throw InputError(message + "; at least " + std::to_string(kMinImages) +
                   " different ones are needed, two to reconstruct from and one held out");
}

// Numbers the groups of photos with the same make, model, focal length and size, as their sensors had them, in order of
// appearance.
int GroupCameras(std::vector<CaptureImage>& images) {
  std::map<std::tuple<std::string, std::string, double, std::pair<int, int>>, int> groups;
  for (CaptureImage& image : images) {
    const ImageInfo& info = image.info;
    const auto key = std::tuple(info.make, info.model, info.focal_px.value_or(0), SensorSize(info));
    image.camera = groups.emplace(key, static_cast<int>(groups.size())).first->second;
  }
  return static_cast<int>(groups.size());
}

// Added photos may lie between the earlier ones.
bool IsOrderedByPath(const std::vector<fs::path>& paths, const std::vector<std::optional<std::string>>& timestamps) {
  std::vector<fs::path> sorted_paths;
  std::vector<std::optional<std::string>> sorted_timestamps;
  for (const size_t i : OrderByPath(paths)) {
    sorted_paths.push_back(paths[i]);
    sorted_timestamps.push_back(timestamps[i]);
  }
  return IsOrdered(sorted_paths, sorted_timestamps);
}

Capture MakeCapture(const Source& source, std::optional<Masks> masks, std::vector<MeasuredPhoto> photos) {
  Capture capture;
  capture.name = source.name;
  capture.kind = source.kind;
  capture.root = source.root;
  capture.posed = source.model.has_value();
  capture.background = source.background;
  capture.box = source.box;
  capture.rejected = source.rejected;
  if (!capture.posed) RejectCopies(photos);  // posed copies may be views that show nothing
  std::vector<std::optional<Split>> given;
  std::vector<DifferenceHash> looks;
  std::vector<FrameShares> frames;
  std::vector<fs::path> paths;
  std::vector<std::optional<std::string>> timestamps;
  for (MeasuredPhoto& photo : photos) {
    if (photo.rejected) {
      capture.rejected.push_back(std::move(*photo.rejected));
      continue;
    }
    char id[16];
    std::snprintf(id, sizeof(id), "%06zu", capture.images.size());
    photo.image.id = id;
    given.push_back(photo.given_split);
    looks.push_back(photo.look);
    frames.push_back(photo.frame);
    paths.push_back(photo.image.path);
    timestamps.push_back(photo.image.info.timestamp);
    capture.images.push_back(std::move(photo.image));
  }
  CheckEnough(source, capture.images.size(), capture.rejected);
  std::vector<Split> splits;
  capture.split_rule = FreezeHoldOut(given, splits);
  std::vector<FrameShares> training_frames;
  for (size_t i = 0; i < splits.size(); ++i) {
    capture.images[i].split = splits[i];
    if (splits[i] == Split::kTrain) training_frames.push_back(frames[i]);
  }
  const bool has_alpha = std::any_of(capture.images.begin(), capture.images.end(),
                                     [](const CaptureImage& image) { return image.info.channels == 4; });
  const bool has_masks = std::any_of(capture.images.begin(), capture.images.end(),
                                     [](const CaptureImage& image) { return !image.mask.empty(); });
  capture.masks = masks.value_or(has_masks ? Masks::kIgnore : Masks::kBackground);
  if (capture.background == Background::kNone) {
    capture.background =
        has_alpha && capture.masks == Masks::kBackground ? Background::kWhite : PlainBackground(training_frames);
  }
  // Frames are chosen by how the picture moves: gaps in their numbers say nothing.
  const bool one_video = source.videos.size() == 1 && std::all_of(capture.images.begin(), capture.images.end(),
                                                                  [](const auto& image) { return image.extracted; });
  capture.ordered = one_video || IsOrderedByPath(paths, timestamps);
  for (const std::vector<int>& group : GroupAlike(looks)) {
    std::vector<std::string>& names = capture.duplicates.emplace_back();
    for (int index : group) names.push_back(EscapePath(paths[index]));
  }
  return capture;
}

// The earlier capture's photos first, in its order, so that they keep their ids; photos that cannot be used stay last.
std::vector<MeasuredPhoto> InEarlierOrder(const AddedPhotos& added, const std::vector<size_t>& usable,
                                          std::vector<MeasuredPhoto> photos) {
  std::vector<MeasuredPhoto> ordered;
  for (const std::vector<size_t>* places : {&added.earlier, &added.added}) {
    for (const size_t i : *places) ordered.push_back(photos[usable[i]]);
  }
  for (MeasuredPhoto& photo : photos) {
    if (photo.rejected) ordered.push_back(std::move(photo));
  }
  return ordered;
}

constexpr char kCountedOn[] = "; added photos count on";  // in split_rule

// The capture as an extension of an earlier one; nothing, with the reason, where it is none.
std::optional<Capture> ExtendedCapture(const Source& source, const Capture& earlier, std::optional<Masks> masks,
                                       const std::vector<MeasuredPhoto>& photos, std::string& why_none) {
  std::vector<size_t> usable;
  std::vector<PhotoBytes> now;
  for (size_t i = 0; i < photos.size(); ++i) {
    const CaptureImage& image = photos[i].image;
    if (photos[i].rejected) continue;
    usable.push_back(i);
    now.push_back({image.path, image.hash, image.mask, image.mask_hash});
  }
  const AddedPhotos added = FindAdded(earlier, source.model.has_value(), !source.videos.empty(), now);
  why_none = added.why_none;
  if (!why_none.empty()) return {};
  Capture capture = MakeCapture(source, masks, InEarlierOrder(added, usable, photos));
  if (capture.background != earlier.background || capture.masks != earlier.masks) {
    why_none = "with the added photos, backgrounds and masks mean something else";
    return {};
  }
  for (size_t i = 0; i < earlier.images.size(); ++i) capture.images[i].split = earlier.images[i].split;
  if (!capture.split_rule.ends_with(kCountedOn)) capture.split_rule += kCountedOn;
  return capture;
}

// The given poses for the photos that are used: images named by id, cameras of the photos' sizes, tracks without the
// images that are left out.
ColmapModel GivenModel(const ColmapModel& given, const Capture& capture) {
  std::map<std::string, const CaptureImage*> used;
  for (const CaptureImage& image : capture.images) used.emplace(image.path.native(), &image);
  ColmapModel model;
  std::map<std::tuple<uint32_t, int, int>, uint32_t> camera_ids;
  for (const auto& [id, posed] : given.images) {
    const auto it = used.find(posed.name);
    if (it == used.end()) continue;
    const ImageInfo& info = it->second->info;
    const ColmapCamera& camera = given.cameras.at(posed.camera_id);
    const auto next_id = static_cast<uint32_t>(camera_ids.size() + 1);
    const auto [known, is_new] = camera_ids.emplace(std::tuple(camera.id, info.width, info.height), next_id);
    if (is_new) {
      ColmapCamera scaled = ScaledCamera(camera, info.width, info.height);
      scaled.id = next_id;
      model.cameras.emplace(next_id, std::move(scaled));
    }
    ColmapImage image = posed;
    image.name = it->second->id;
    image.camera_id = known->second;
    for (ColmapObservation& observation : image.observations) {
      observation.x *= static_cast<double>(info.width) / camera.width;
      observation.y *= static_cast<double>(info.height) / camera.height;
    }
    model.images.emplace(id, std::move(image));
    used.erase(it);
  }
  for (const auto& [id, point] : given.points) {
    ColmapPoint kept = point;
    std::erase_if(kept.track, [&](const auto& element) { return !model.images.contains(element.first); });
    if (!kept.track.empty() || point.track.empty()) model.points.emplace(id, std::move(kept));
  }
  for (auto& [id, image] : model.images) {
    for (ColmapObservation& observation : image.observations) {
      if (!model.points.contains(static_cast<uint64_t>(observation.point_id))) observation.point_id = -1;
    }
  }
  return model;
}

// The frames of the source's videos become images of it, those that cannot be decoded are rejected. Returns what was
// found, as videos.json has it.
Json TakeFrames(int n_wanted, ArtifactWriter& artifact, Source& source) {
  Json videos = Json::array();
  std::vector<std::string> stems;
  for (const fs::path& video : source.videos) {
    const std::string name = EscapePath(video);
    try {
      ExtractedVideo extracted = ExtractFrames(source.root / video, name, n_wanted, artifact.dir(), stems);
      for (const fs::path& frame : extracted.frames) {
        source.images.push_back({.path = frame, .split = {}, .extracted = true, .video = name});
      }
      videos.push_back(std::move(extracted.record));
    } catch (const Error& error) {
      if (error.code() != ExitCode::kInput) throw;
      source.rejected.push_back(Rejection(source.root, video, error));
    }
  }
  if (videos.empty()) return videos;
  std::stable_sort(source.images.begin(), source.images.end(),
                   [](const SourceImage& a, const SourceImage& b) { return a.path.native() < b.path.native(); });
  WriteJson(artifact.dir() / kVideosFile, {{"schema_version", kVideosSchemaVersion}, {"videos", videos}});
  for (const char* output : {kVideosFile, kFramesDir, kThumbnailsDir}) artifact.AddOutput(output);
  return videos;
}

// By the files as they are: photos that turned out to be of no use before are none of those added.
AddedPhotos ProbeAdded(const Source& source, const Capture& earlier) {
  std::set<std::string> rejected;
  for (const RejectedFile& file : earlier.rejected) rejected.insert(file.name);
  std::vector<PhotoBytes> now;
  for (const SourceImage& image : source.images) {
    if (rejected.contains(EscapePath(image.path))) continue;
    const bool masked = !image.mask.empty();
    now.push_back({image.path, HashFile(source.root / image.path), image.mask,
                   masked ? HashFile(source.root / image.mask) : std::string()});
  }
  AddedPhotos added = FindAdded(earlier, source.model.has_value(), !source.videos.empty(), now);
  if (added.why_none.empty() && added.added.empty()) added.why_none = "no photo was added";
  return added;
}

void SetExtension(const Capture& earlier, size_t n_added, const std::string& why_none, Json& facts) {
  const bool is_one = why_none.empty();
  facts["extension"] = is_one ? Json({{"n_earlier", earlier.images.size()}, {"n_added", n_added}}) : Json();
  facts["why_anew"] = is_one ? Json() : Json(why_none);
}

}  // namespace

Json ProbeCapture(const fs::path& capture, const fs::path& base) {
  const Source source = RecogniseCapture(CapturePath(capture));
  if (source.videos.empty()) CheckEnough(source, source.images.size(), source.rejected);
  std::vector<std::optional<Split>> given;
  bool has_alpha = false;
  int n_masks = 0;
  for (const SourceImage& image : source.images) {
    n_masks += image.mask.empty() ? 0 : 1;
    given.push_back(image.split);
    try {
      has_alpha = has_alpha || ProbeImage(source.root / image.path).channels == 4;
    } catch (const Error& error) {
      LogDetail(error.what());  // Ingest rejects it by name
    }
  }
  std::vector<Split> splits;
  const std::string rule = FreezeHoldOut(given, splits);
  const int n_test = static_cast<int>(std::count(splits.begin(), splits.end(), Split::kTest));
  const int n_images = static_cast<int>(splits.size());
  Json facts = {{"kind", source.kind},          {"name", source.name},
                {"n_images", n_images},         {"posed", source.model.has_value()},
                {"split_rule", rule},           {"has_alpha", has_alpha},
                {"n_train", n_images - n_test}, {"n_test", n_test},
                {"n_masks", n_masks},           {"n_videos", source.videos.size()}};
  if (!base.empty()) {
    const Capture earlier = LoadCapture(base);
    const AddedPhotos added = ProbeAdded(source, earlier);
    SetExtension(earlier, added.added.size(), added.why_none, facts);
  }
  return facts;
}

HashedPath CaptureInput(const fs::path& capture) {
  const fs::path path = CapturePath(capture);
  return {EscapePath(path), HashTree(path), 0};
}

void Ingest(const fs::path& capture_path, const IngestOptions& options, ArtifactWriter& artifact) {
  Source source = RecogniseCapture(CapturePath(capture_path));
  if (options.without_masks) {
    for (SourceImage& image : source.images) image.mask.clear();
  }
  LogInfo(EscapePath(source.root) + " is a capture of kind " + source.kind + ": " + source.evidence);
  const Json videos = TakeFrames(options.frames, artifact, source);
  std::vector<MeasuredPhoto> photos = MeasureAll(source, artifact.dir(), options.n_threads);
  std::optional<Capture> earlier, extended;
  std::string why_anew;
  if (!options.base.empty()) {
    earlier = LoadCapture(options.base);
    extended = ExtendedCapture(source, *earlier, options.masks, photos, why_anew);
  }
  Capture capture = extended ? std::move(*extended) : MakeCapture(source, options.masks, std::move(photos));
  const int n_cameras = GroupCameras(capture.images);
  SaveCapture(capture, artifact.dir());
  artifact.AddOutput(kCaptureFile);
  if (source.model) {
    WriteColmapBinary(GivenModel(*source.model, capture), artifact.dir() / kGivenModelDir);
    artifact.AddOutput(kGivenModelDir);
  }
  artifact.facts() = IngestFacts(capture, n_cameras);
  int n_frames = 0, n_kept = 0;
  for (const Json& video : videos) {
    n_frames += int(video["verdict"].size());
    n_kept += int(std::count(video["verdict"].begin(), video["verdict"].end(), "kept"));
  }
  artifact.facts()["n_videos"] = videos.size();
  artifact.facts()["n_frames"] = n_frames;
  artifact.facts()["n_frames_kept"] = n_kept;
  if (earlier) {
    SetExtension(*earlier, capture.images.size() - earlier->images.size(), why_anew, artifact.facts());
    if (extended) {
      LogInfo(artifact.facts()["extension"]["n_added"].dump() + " photos were added to " +
              std::to_string(earlier->images.size()) + ", which stay held out or not as they were");
    } else {
      LogWarning("everything is made anew: " + why_anew);
    }
  }
  artifact.AddDecision(needs::Sfm(capture.posed, source.evidence));
  if (options.frames > 0 && source.videos.empty()) LogWarning("--frames does nothing here: there is no video");
  if (options.masks && artifact.facts()["has_alpha"] == false) {
    LogWarning("--masks does nothing here: there are no masks and no alpha channels");
  }
  LogIngestFacts(capture, artifact.facts());
}

}  // namespace nrff
