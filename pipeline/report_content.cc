#include "pipeline/report_content.h"

#include <fmt/format.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <map>
#include <numeric>
#include <string>
#include <string_view>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/report_page.h"
#include "pipeline/scene.h"
#include "pipeline/workspace.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr size_t kMaxPoints = 30000;  // a canvas turns this many smoothly

struct ViewFiles {
  fs::path truth, rendered, error, depth, normal;

  size_t Bytes() const {
    size_t bytes = 0;
    for (const fs::path* file : {&truth, &rendered, &error, &depth, &normal}) {
      std::error_code none;
      const auto size = fs::file_size(*file, none);
      if (!none) bytes += size;
    }
    return bytes;
  }
};

ViewFiles FilesOf(const WorkspaceState& state, const Json& image) {
  const auto path = [&](const char* key) {
    return state.root / UnescapePath(Get<std::string>(image, key, "the summary's images"));
  };
  ViewFiles files{path("truth"), path("rendered"), path("error"), {}, {}};
  const fs::path layers = files.rendered.parent_path().parent_path();
  files.depth = layers / "depth" / files.rendered.filename();
  files.normal = layers / "normal" / files.rendered.filename();
  return files;
}

// type: "png" or "jpeg". Null where the file is not there.
Json DataUri(const char* type, const fs::path& file) {
  try {
    return fmt::format("data:image/{};base64,", type) + Base64(ReadFile(file));
  } catch (const Error&) {
    return nullptr;
  }
}

// Image indices from the lowest PSNR to the highest; a view identical to its photo (null) is best.
std::vector<size_t> ByPsnr(const Json& images) {
  std::vector<size_t> order(images.size());
  std::iota(order.begin(), order.end(), 0);
  const auto psnr = [&](size_t i) {
    const Json& value = At(images[i], "psnr");
    return value.is_number() ? value.get<double>() : HUGE_VAL;
  };
  std::stable_sort(order.begin(), order.end(), [&](size_t a, size_t b) { return psnr(a) < psnr(b); });
  return order;
}

bool FitsWhole(const Json& images, const std::vector<ViewFiles>& files) {
  size_t bytes = 0;
  int side = 0;
  for (size_t i = 0; i < files.size(); ++i) {
    bytes += files[i].Bytes();
    for (const char* key : {"width", "height"}) side = std::max(side, Get<int>(images[i], key, "the summary's images"));
  }
  return files.size() <= kMaxPictureViews && side <= kMaxPictureSidePx && bytes <= kMaxPictureBytes;
}

struct PointCloud {
  std::vector<float> positions;  // [n, 3]
  std::vector<uint8_t> colors;   // [n, 3]
  size_t n_total = 0;            // before thinning
};

// Of the pose stage's points.ply (binary little endian; float x y z, uchar red green blue), every k-th.
PointCloud ReadPoints(const fs::path& file) {
  static_assert(std::endian::native == std::endian::little);
  constexpr size_t kStride = 3 * sizeof(float) + 3;
  const std::string bytes = ReadFile(file);
  const auto damaged = [&](const std::string& what) {
    return CorruptError("Points " + EscapePath(file) + " " + what + "; run the pose stage again.");
  };
  constexpr std::string_view kElement = "element vertex ", kEnd = "end_header\n";
  const size_t element = bytes.find(kElement), end = bytes.find(kEnd);
  if (element == std::string::npos || end == std::string::npos || element > end) throw damaged("have no PLY header");
  PointCloud cloud;
  cloud.n_total = std::strtoull(bytes.c_str() + element + kElement.size(), nullptr, 10);
  const size_t start = end + kEnd.size();
  if (cloud.n_total > (bytes.size() - start) / kStride) throw damaged("are cut short");
  const size_t step = std::max<size_t>(1, (cloud.n_total + kMaxPoints - 1) / kMaxPoints);
  for (size_t i = 0; i < cloud.n_total; i += step) {
    const char* point = bytes.data() + start + i * kStride;
    float position[3];
    std::memcpy(position, point, sizeof position);
    if (!std::all_of(position, position + 3, [](float v) { return std::isfinite(v); })) continue;
    cloud.positions.insert(cloud.positions.end(), position, position + 3);
    cloud.colors.insert(cloud.colors.end(), point + sizeof position, point + kStride);
  }
  return cloud;
}

}  // namespace

Json Pictures(const WorkspaceState& state, const Json& images) {
  std::vector<ViewFiles> files;
  for (const Json& image : images) files.push_back(FilesOf(state, image));
  std::vector<size_t> shown(images.size());
  std::iota(shown.begin(), shown.end(), 0);
  std::string note;
  if (!FitsWhole(images, files) && images.size() > 3) {
    const std::vector<size_t> order = ByPsnr(images);
    shown = {order.front(), order[order.size() / 2], order.back()};
    note = fmt::format(
        "Pictures of 3 of {} views, to keep this page small: the worst, the median and the best by "
        "PSNR. The table has the figures of all; their pictures are in the workspace's render and eval "
        "folders.",
        images.size());
  }
  Json views = Json::array();
  for (size_t i : shown) {
    views.push_back({{"image", i},
                     {"truth", DataUri("png", files[i].truth)},
                     {"rendered", DataUri("png", files[i].rendered)},
                     {"error", DataUri("png", files[i].error)},
                     {"depth", DataUri("png", files[i].depth)},
                     {"normal", DataUri("png", files[i].normal)}});
  }
  return {{"views", views}, {"note", note}};
}

Json MedianPicture(const WorkspaceState& state, const Json& images) {
  if (images.empty()) return nullptr;
  return DataUri("png", FilesOf(state, images[ByPsnr(images)[images.size() / 2]]).rendered);
}

Json Comparisons(const std::vector<Run>& runs) {
  std::map<std::string, std::vector<size_t>> by_capture;  // those that scored images
  for (size_t r = 0; r < runs.size(); ++r) {
    if (runs[r].summary.at("images").empty()) continue;
    by_capture[Workspace(runs[r].state.root).ReadMarker().capture].push_back(r);
  }
  Json comparisons = Json::array();
  for (const auto& [capture, of_capture] : by_capture) {
    if (of_capture.size() < 2) continue;
    std::map<std::string, std::vector<const Json*>> by_name;  // the runs' images, in the runs' order
    for (const size_t r : of_capture) {
      for (const Json& image : runs[r].summary.at("images")) by_name[image.at("name")].push_back(&image);
    }
    Json shared = Json::array();
    for (const auto& [name, images] : by_name) {
      if (images.size() != of_capture.size()) continue;
      double sum = 0;
      for (const Json* image : images)
        sum += image->at("psnr").is_number() ? image->at("psnr").get<double>() : HUGE_VAL;
      shared.push_back({{"name", name}, {"psnr", std::isfinite(sum) ? Json(sum) : Json()}});
    }
    const std::vector<size_t> order = ByPsnr(shared);
    Json views = Json::array();
    for (size_t k = 0; k < std::min<size_t>(order.size(), 3); ++k) {
      const size_t place = order.size() <= 3 ? k : k == 0 ? 0 : k == 1 ? order.size() / 2 : order.size() - 1;
      const std::vector<const Json*>& images = by_name.at(shared[order[place]].at("name"));
      Json shown = Json::array(), truth;
      for (size_t i = 0; i < images.size(); ++i) {
        const ViewFiles files = FilesOf(runs[of_capture[i]].state, *images[i]);
        if (truth.is_null()) truth = DataUri("png", files.truth);
        shown.push_back({{"rendered", DataUri("png", files.rendered)},
                         {"error", DataUri("png", files.error)},
                         {"psnr", images[i]->at("psnr")}});
      }
      views.push_back({{"name", images.front()->at("name")}, {"truth", truth}, {"shown", shown}});
    }
    if (!views.empty()) {
      comparisons.push_back(
          {{"capture", runs[of_capture.front()].summary.at("name")}, {"runs", of_capture}, {"views", views}});
    }
  }
  return comparisons;
}

Json Geometry(const WorkspaceState& state) {
  if (!state.Stage("pose").manifest) return nullptr;
  const fs::path dir = state.root / "pose";
  const Scene scene = LoadScene(dir);
  Json cameras = Json::array();
  for (const View& view : scene.views) {
    cameras.push_back({{"name", view.name},
                       {"split", view.split == Split::kTrain ? "train" : "test"},
                       {"scene_from_camera", view.scene_from_camera},
                       {"slope_x", 0.5 * view.width / view.fx},
                       {"slope_y", 0.5 * view.height / view.fy}});
  }
  Json points;
  if (fs::exists(dir / "points.ply")) {
    const PointCloud cloud = ReadPoints(dir / "points.ply");
    const auto as_bytes = [](const auto& values) {
      return std::string_view(reinterpret_cast<const char*>(values.data()), values.size() * sizeof values[0]);
    };
    points = {{"n", cloud.positions.size() / 3},
              {"n_total", cloud.n_total},
              {"positions", Base64(as_bytes(cloud.positions))},
              {"colors", Base64(as_bytes(cloud.colors))}};
  }
  return {{"points", points}, {"cameras", cameras}};
}

namespace {

Json LeftOutPhotos(const WorkspaceState& state, const Json& unused) {
  Json photos = Json::array();
  const auto add = [&](const Json& names, const char* reason) {
    for (const Json& name : names) photos.push_back({{"name", name}, {"reason", reason}});
  };
  for (const Json& file : At(state.Facts("ingest"), "rejected")) {
    photos.push_back({{"name", At(file, "name")}, {"reason", At(file, "reason")}});
  }
  add(At(state.Facts("sfm"), "unregistered"), "no pose: too few of its features are those of photos that have one");
  add(unused, "has a pose, but fewer than three points, or none that others see");
  return photos;
}

}  // namespace

Json Certificate(const WorkspaceState& state) {
  const fs::path file = state.root / "sfm" / "refinement.json";
  if (!state.Stage("sfm").manifest || !state.Stage("pose").manifest || !fs::exists(file)) return nullptr;
  const std::string where = EscapePath(file);
  const Json json = ReadJson(file);
  CheckSchemaVersion(json, 1, where);
  const Scene scene = LoadScene(state.root / "pose");
  std::map<std::string, const View*> views;
  for (const View& view : scene.views) views[view.id] = &view;
  // A photo is called by its name where the scene knows it.
  const auto name_of = [&](const std::string& id) { return views.contains(id) ? views.at(id)->name : id; };
  const Mat4& m = scene.scene_from_world;
  const double scale = std::sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2]);

  Json cameras = Json::array();
  std::vector<std::pair<double, Json>> known;
  for (const Json& image : Get<std::vector<Json>>(json, "images", where)) {
    const auto view = views.find(Get<std::string>(image, "name", where));
    if (view == views.end()) continue;
    const Mat4& pose = view->second->scene_from_camera;
    const double distance = std::sqrt(pose[3] * pose[3] + pose[7] * pose[7] + pose[11] * pose[11]);
    const double position = scale * Get<double>(image, "position_deviation", where) / std::max(distance, 1e-6);
    known.emplace_back(position, Json{{"name", view->second->name},
                                      {"split", view->second->split == Split::kTrain ? "train" : "test"},
                                      {"position", position},
                                      {"rotation_deg", Get<double>(image, "rotation_deviation_deg", where)}});
  }
  std::stable_sort(known.begin(), known.end(), [](const auto& a, const auto& b) { return a.first > b.first; });
  for (auto& [position, camera] : known) cameras.push_back(std::move(camera));

  std::map<int, int64_t> tracks;  // by length as a number
  for (const auto& [length, n] : Get<std::map<std::string, int64_t>>(json, "track_lengths", where)) {
    tracks[std::atoi(length.c_str())] = n;
  }
  Json track_lengths = Json::array();
  for (const auto& [length, n] : tracks) track_lengths.push_back({{"length", length}, {"n", n}});
  std::vector<size_t> components;
  for (const Json& component : Get<std::vector<Json>>(json, "components", where)) {
    components.push_back(Get<std::vector<std::string>>(component, "images", where).size());
  }
  std::sort(components.rbegin(), components.rend());
  const Json left_out = Get<Json>(json, "left_out", where);
  Json unused = Json::array();
  for (const std::string& id : Get<std::vector<std::string>>(left_out, "images", where)) unused.push_back(name_of(id));
  return {{"n_points", Get<size_t>(json, "n_points", where)},
          {"n_observations", Get<size_t>(json, "n_observations", where)},
          {"degeneracy", At(json, "degeneracy")},
          {"structure", Get<std::vector<std::string>>(json, "structure", where)},
          {"reason", At(json, "reason")},
          {"converged", Get<bool>(json, "converged", where)},
          {"remaining", At(json, "remaining_deviations")},
          {"iterations", Get<int>(json, "iterations", where)},
          {"error_px", Get<Json>(json, "reprojection_error_px", where)},
          {"n_left_out",
           {{"points", Get<size_t>(left_out, "n_points", where)},
            {"behind", Get<size_t>(left_out, "n_observations_behind", where)},
            {"beyond_lens", Get<size_t>(left_out, "n_observations_beyond_lens", where)}}},
          {"track_lengths", track_lengths},
          {"components", components},
          {"cameras", cameras},
          {"left_out", LeftOutPhotos(state, unused)}};
}

Json VideoFrames(const WorkspaceState& state) {
  const fs::path ingest = state.root / "ingest", file = ingest / "videos.json";
  if (!fs::exists(file)) return nullptr;
  const std::string where = EscapePath(file);
  Json videos = Json::array();
  for (const Json& video : Get<std::vector<Json>>(ReadJson(file), "videos", where)) {
    const auto verdicts = Get<std::vector<std::string>>(video, "verdict", where);
    const auto rate = Get<double>(video, "frames_per_second", where);
    Json counts = {{"kept", 0}, {"repeated", 0}, {"blurred", 0}, {"near", 0}}, thumbnails = Json::array();
    for (const std::string& verdict : verdicts) counts[verdict] = counts.value(verdict, 0) + 1;
    for (const Json& thumbnail : Get<std::vector<Json>>(video, "thumbnails", where)) {
      const auto frame = Get<size_t>(thumbnail, "frame", where);
      const fs::path picture = fs::path(Get<std::string>(thumbnail, "file", where)).lexically_normal();
      if (frame >= verdicts.size() || picture.empty() || *picture.begin() != "thumbnails") {
        throw CorruptError(where + ": has a thumbnail of no frame, or elsewhere than in thumbnails/: run ingest again");
      }
      thumbnails.push_back({{"picture", DataUri("jpeg", ingest / picture)},
                            {"seconds", rate > 0 ? Json(double(frame) / rate) : Json()},
                            {"verdict", verdicts[frame]}});
    }
    videos.push_back({{"name", Get<std::string>(video, "name", where)},
                      {"n_frames", verdicts.size()},
                      {"verdicts", counts},
                      {"thumbnails", thumbnails}});
  }
  return videos;
}

}  // namespace nrff
