#include "sfm/transforms_json.h"

#include <Eigen/LU>
#include <algorithm>
#include <array>
#include <cmath>
#include <initializer_list>
#include <limits>
#include <map>
#include <string>
#include <string_view>
#include <utility>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"
#include "pipeline/statistics.h"
#include "sfm/image_io.h"
#include "sfm/normalise.h"

namespace nrff {
namespace {

// Of the box that the NeRF-synthetic objects lie in, in distances of the cameras from the point that they look at: ±1.5
// about the origin, which is 4.0311 away.
constexpr double kSyntheticHalfExtent = 1.5 / 4.0311;

// OpenGL camera axes ↔ OpenCV's: y and z change sign.
Eigen::Matrix4d FlipCameraAxes(Eigen::Matrix4d world_from_camera) {
  world_from_camera.col(1) *= -1;
  world_from_camera.col(2) *= -1;
  return world_from_camera;
}

// Python's json writes NaN, Infinity and -Infinity; as null they can be reported with their frame.
std::string WithoutPythonLiterals(std::string_view text) {
  std::string clean;
  clean.reserve(text.size());
  bool in_string = false;
  while (!text.empty()) {
    size_t n = 1;
    if (in_string && text[0] == '\\') {
      n = std::min<size_t>(2, text.size());
    } else if (text[0] == '"') {
      in_string = !in_string;
    } else if (!in_string) {
      size_t literal = 0;
      for (std::string_view word : {"NaN", "Infinity", "-Infinity"}) {
        if (text.starts_with(word)) literal = word.size();
      }
      if (literal > 0) {
        clean += "null";
        text.remove_prefix(literal);
        continue;
      }
    }
    clean += text.substr(0, n);
    text.remove_prefix(n);
  }
  return clean;
}

Json ReadPythonJson(const std::filesystem::path& file) {
  try {
    return ParseJson(WithoutPythonLiterals(ReadFile(file)));
  } catch (const JsonSyntaxError& error) {
    throw InputError(EscapePath(file) + ": is not valid JSON (" + error.what() + "); export it again");
  }
}

// NaN for null, which is what Python's NaN was turned into.
double ToNumber(const Json& value, const std::string& what, const std::string& where) {
  if (value.is_null()) return std::numeric_limits<double>::quiet_NaN();
  if (!value.is_number()) throw InputError(where + ": " + what + " is " + value.dump() + "; expected a number");
  return value.get<double>();
}

// A 3×4 or 4×4 matrix as rows.
Eigen::Matrix4d ToMatrix(const Json& value, const std::string& what, const std::string& where) {
  Eigen::Matrix4d matrix = Eigen::Matrix4d::Identity();
  bool shaped = value.is_array() && (value.size() == 3 || value.size() == 4);
  for (size_t row = 0; shaped && row < value.size(); ++row) shaped = value[row].is_array() && value[row].size() == 4;
  if (!shaped) throw InputError(where + ": " + what + " is not a 4×4 or 3×4 matrix of rows");
  for (size_t row = 0; row < value.size(); ++row) {
    for (size_t column = 0; column < 4; ++column) matrix(row, column) = ToNumber(value[row][column], what, where);
  }
  return matrix;
}

// A frame's value, else the file's.
class Settings {
 public:
  Settings(const Json& frame, const Json& file, const std::string& where) : frame_(frame), file_(file), where_(where) {}

  const Json* Find(const char* key) const {
    for (const Json* level : {&frame_, &file_}) {
      if (auto it = level->find(key); it != level->end()) return &*it;
    }
    return nullptr;
  }

  std::optional<double> Number(const char* key) const {
    const Json* value = Find(key);
    if (!value) return {};
    const double number = ToNumber(*value, std::string("\"") + key + "\"", where_);
    if (!std::isfinite(number)) throw InputError(where_ + ": \"" + key + "\" is not a finite number");
    return number;
  }

  std::string Text(const char* key) const {
    const Json* value = Find(key);
    return value && value->is_string() ? value->get<std::string>() : std::string();
  }

  const std::string& where() const { return where_; }

 private:
  const Json& frame_;
  const Json& file_;
  const std::string& where_;
};

bool IsFisheye(const Settings& settings) {
  const std::string name = settings.Text("camera_model");
  if (name == "OPENCV_FISHEYE") return true;
  for (const char* known :
       {"", "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV", "PERSPECTIVE"}) {
    if (name == known) {
      const Json* flag = settings.Find("is_fisheye");
      return flag && flag->is_boolean() && flag->get<bool>();
    }
  }
  throw InputError(settings.where() + ": camera_model " + EscapePath(name) +
                   " cannot be used; expected PINHOLE, OPENCV or OPENCV_FISHEYE");
}

// The camera with as few parameters as the distortion needs. `photo` tells the size where the file does not.
ColmapCamera ReadCamera(const Settings& settings, const ImageInfo& photo) {
  ColmapCamera camera;
  const auto w = settings.Number("w"), h = settings.Number("h");
  camera.width = w && h ? static_cast<int>(std::clamp(*w, 0.0, 1e6)) : photo.width;
  camera.height = w && h ? static_cast<int>(std::clamp(*h, 0.0, 1e6)) : photo.height;
  auto from_angle = [](std::optional<double> angle, int side) -> std::optional<double> {
    if (!angle) return {};
    return side / (2 * std::tan(*angle / 2));
  };
  auto fx = settings.Number("fl_x"), fy = settings.Number("fl_y");
  if (!fx) fx = from_angle(settings.Number("camera_angle_x"), camera.width);
  if (!fy && settings.Number("fl_x")) fy = fx;
  if (!fy) fy = from_angle(settings.Number("camera_angle_y"), camera.height);
  if (!fx) fx = fy;
  if (!fx) throw InputError(settings.where() + ": has no focal length; expected fl_x or camera_angle_x");
  if (!fy) fy = fx;
  if (!(*fx > 0) || !(*fy > 0) || !std::isfinite(*fx + *fy) || camera.width <= 0 || camera.height <= 0) {
    throw InputError(settings.where() + ": focal length and size must be positive and finite; found fl_x " +
                     std::to_string(*fx) + ", w " + std::to_string(camera.width) + ", h " +
                     std::to_string(camera.height));
  }
  auto number = [&](const char* key) { return settings.Number(key).value_or(0); };
  camera.params = {*fx, *fy, settings.Number("cx").value_or(camera.width / 2.0),
                   settings.Number("cy").value_or(camera.height / 2.0)};
  auto extend = [&](CameraModel model, std::initializer_list<const char*> keys) {
    camera.model = model;
    for (const char* key : keys) camera.params.push_back(number(key));
    return camera;
  };
  auto any = [&](std::initializer_list<const char*> keys) {
    return std::any_of(keys.begin(), keys.end(), [&](const char* key) { return number(key) != 0; });
  };
  if (IsFisheye(settings)) return extend(CameraModel::kOpenCVFisheye, {"k1", "k2", "k3", "k4"});
  if (any({"k4", "k5", "k6"}) && settings.Text("camera_model") != "FULL_OPENCV") {
    throw InputError(settings.where() +
                     ": k4 to k6 are given, but camera_model is not FULL_OPENCV, the only one in which they"
                     " have a known meaning; leave them out or undistort the photos");
  }
  if (any({"k3", "k4", "k5", "k6"})) {
    return extend(CameraModel::kFullOpenCV, {"k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"});
  }
  if (any({"k1", "k2", "p1", "p2"})) return extend(CameraModel::kOpenCV, {"k1", "k2", "p1", "p2"});
  return camera;
}

// The photo a file_path names: as it is, with an extension, as this project writes names (escaped), with Windows'
// slashes.
std::filesystem::path FindFramePhoto(const std::filesystem::path& root, const std::string& file_path) {
  std::string slashed = file_path;
  std::replace(slashed.begin(), slashed.end(), '\\', '/');
  for (const std::filesystem::path& name :
       {std::filesystem::path(file_path), UnescapePath(file_path), std::filesystem::path(slashed)}) {
    const std::filesystem::path found = FindPhoto(root, name);
    if (!found.empty()) return found.is_absolute() ? found.lexically_proximate(root) : found.lexically_normal();
  }
  return {};
}

// nerfstudio's lists of file_paths: which frame is in which split. val stands in where there is no test.
std::map<std::string, Split> NamedSplits(const Json& json) {
  auto has = [&](const char* key) { return json.contains(key) && json[key].is_array() && !json[key].empty(); };
  std::map<std::string, Split> splits;
  const char* test = has("test_filenames") ? "test_filenames" : "val_filenames";
  if (!has("train_filenames") || !has(test)) return splits;
  for (const auto& [key, split] : {std::pair{"train_filenames", Split::kTrain}, std::pair{test, Split::kTest}}) {
    for (const Json& name : json[key]) {
      if (name.is_string()) splits[name.get<std::string>()] = split;
    }
  }
  return splits;
}

// file_from_world of a file whose poses were moved: first applied_transform, then applied_scale.
struct Applied {
  Eigen::Matrix4d transform = Eigen::Matrix4d::Identity();
  double scale = 1;
};

Applied ReadApplied(const Json& json, const std::string& name) {
  Applied applied;
  if (json.contains("applied_transform")) {
    applied.transform = ToMatrix(json["applied_transform"], "applied_transform", name);
    CheckRigid(applied.transform, name + ", applied_transform");
  }
  if (json.contains("applied_scale")) applied.scale = ToNumber(json["applied_scale"], "applied_scale", name);
  if (!(applied.scale > 0) || !std::isfinite(applied.scale)) {
    throw InputError(name + ": applied_scale is " + std::to_string(applied.scale) + "; expected a positive number");
  }
  return applied;
}

// Adds the frames of one file. `split`: of all its frames, where the file stands for one.
void AddFrames(const std::filesystem::path& file, std::optional<Split> split, Source& source, size_t& n_frames) {
  const std::string name = EscapePath(file);
  const Json json = ReadPythonJson(file);
  if (!json.is_object() || !json.contains("frames") || !json["frames"].is_array() || json["frames"].empty()) {
    throw InputError(name + ": has no \"frames\"; expected a list with file_path and transform_matrix each");
  }
  const Applied applied = ReadApplied(json, name);
  const std::map<std::string, Split> named_splits = NamedSplits(json);
  const bool synthetic = json.contains("camera_angle_x") && !json.contains("fl_x") && !json.contains("aabb_scale");
  for (const Json& frame : json["frames"]) {
    std::string where = name + ", frame " + std::to_string(&frame - &json["frames"][0]);
    if (!frame.is_object() || !frame.contains("file_path") || !frame["file_path"].is_string()) {
      throw InputError(where + ": has no file_path");
    }
    const std::string file_path = frame["file_path"];
    where += " (" + EscapePath(file_path) + ")";
    if (!frame.contains("transform_matrix")) throw InputError(where + ": has no transform_matrix");
    Eigen::Matrix4d pose = ToMatrix(frame["transform_matrix"], "transform_matrix", where);
    CheckRigid(pose, where);
    ++n_frames;
    const std::filesystem::path photo = FindFramePhoto(source.root, file_path);
    if (photo.empty()) {
      source.rejected.push_back(
          {EscapePath(file_path), "named by " + EscapePath(file.filename()) + " but does not exist"});
      continue;
    }
    SourceImage image{photo, split};
    if (!named_splits.empty()) {
      auto named = named_splits.find(file_path);
      if (named == named_splits.end()) continue;  // validation views
      image.split = named->second;
    }
    ImageInfo info;
    try {
      info = ProbeImage(source.root / photo);
    } catch (const Error& error) {
      source.rejected.push_back(Rejection(source.root, photo, error));
      continue;
    }
    if (frame.contains("mask_path") && frame["mask_path"].is_string()) {
      image.mask = FindFramePhoto(source.root, frame["mask_path"]);
      if (image.mask.empty()) {
        source.rejected.push_back({EscapePath(frame["mask_path"].get<std::string>()),
                                   "named by " + EscapePath(file.filename()) + " as a mask but does not exist"});
      }
    }
    if (synthetic && info.channels == 4) {
      source.background = Background::kWhite;
    }
    pose.topRightCorner<3, 1>() /= applied.scale;
    const Eigen::Matrix4d world_from_camera = applied.transform.inverse() * FlipCameraAxes(pose);
    AddPosedImage(source, image, ReadCamera(Settings(frame, json, where), info), world_from_camera, where);
  }
}

// The data set's box, in the units and at the place of this capture's world; none where the cameras look at no point.
std::optional<std::array<double, 6>> SyntheticBox(const ColmapModel& model) {
  std::vector<PosedCamera> cameras;
  for (const auto& [id, image] : model.images) {
    cameras.push_back({image.name, image.rotation.conjugate().toRotationMatrix(), image.Center()});
  }
  const std::optional<Eigen::Vector3d> focus = FocusPoint(cameras);
  if (!focus) return {};
  std::vector<double> distances;
  distances.reserve(cameras.size());
  for (const PosedCamera& camera : cameras) distances.push_back((camera.center - *focus).norm());
  const double half = kSyntheticHalfExtent * Median(std::move(distances));
  if (!(half > 0) || !std::isfinite(half) || !focus->allFinite()) return {};
  const Eigen::Vector3d low = focus->array() - half, high = focus->array() + half;
  return std::array{low[0], low[1], low[2], high[0], high[1], high[2]};
}

Json ToRows(const Eigen::Matrix4d& matrix, int n_rows) {
  Json rows = Json::array();
  for (int i = 0; i < n_rows; ++i) rows.push_back({matrix(i, 0), matrix(i, 1), matrix(i, 2), matrix(i, 3)});
  return rows;
}

// Intrinsics in the format's keys.
Json ToJson(const ColmapCamera& camera, const std::string& where) {
  const std::vector<double>& p = camera.params;
  Json json = {{"w", camera.width}, {"h", camera.height}};
  auto set = [&](const char* model, std::initializer_list<const char*> keys) {
    json["camera_model"] = model;
    auto param = p.begin();
    for (const char* key : keys) json[key] = *param++;
  };
  switch (camera.model) {
    case CameraModel::kSimplePinhole:
      set("PINHOLE", {"fl_x", "cx", "cy"});
      break;
    case CameraModel::kPinhole:
      set("PINHOLE", {"fl_x", "fl_y", "cx", "cy"});
      break;
    case CameraModel::kSimpleRadial:
      set("OPENCV", {"fl_x", "cx", "cy", "k1"});
      break;
    case CameraModel::kRadial:
      set("OPENCV", {"fl_x", "cx", "cy", "k1", "k2"});
      break;
    case CameraModel::kOpenCV:
      set("OPENCV", {"fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"});
      break;
    case CameraModel::kOpenCVFisheye:
      set("OPENCV_FISHEYE", {"fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4"});
      break;
    case CameraModel::kFullOpenCV:
      set("FULL_OPENCV", {"fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"});
      break;
    default:
      throw InputError(where + ": cameras of the model " + CameraModelName(camera.model) +
                       " cannot be written as transforms.json; undistort first");
  }
  if (!json.contains("fl_y")) json["fl_y"] = json["fl_x"];
  return json;
}

}  // namespace

std::optional<Source> ReadTransformsSource(const std::filesystem::path& root) {
  Source source;
  source.kind = "transforms";
  source.root = root;
  size_t n_frames = 0;
  const std::filesystem::path train = root / "transforms_train.json", whole = root / "transforms.json";
  if (IsFile(train)) {
    AddFrames(train, Split::kTrain, source, n_frames);
    source.evidence = "transforms_train.json";
    for (const char* name : {"transforms_test.json", "transforms_val.json"}) {  // val only stands in for a missing test
      if (!IsFile(root / name)) continue;
      AddFrames(root / name, Split::kTest, source, n_frames);
      source.evidence += std::string(" and ") + name;
      break;
    }
  } else if (IsFile(whole)) {
    AddFrames(whole, {}, source, n_frames);
    source.evidence = "transforms.json";
  } else {
    return {};
  }
  source.evidence += " with " + std::to_string(n_frames) + " frames";
  if (source.images.empty() && source.rejected.empty()) {
    throw InputError(
        EscapePath(root) + ": none of the " + std::to_string(n_frames) +
        " frames of the transforms file is in its train_filenames and test_filenames; expected names as in file_path");
  }
  if (source.images.empty()) {
    throw InputError(
        EscapePath(root) + ": none of the " + std::to_string(n_frames) +
        " frames of the transforms file has a photo that can be read (the first: " + source.rejected.front().name +
        " " + source.rejected.front().reason + "); put the photos where file_path says");
  }
  if (source.background == Background::kWhite) source.box = SyntheticBox(*source.model);
  return source;
}

void WriteTransforms(const ColmapModel& model, const std::filesystem::path& file,
                     const Eigen::Matrix<double, 3, 4>& applied_transform, double applied_scale) {
  Eigen::Matrix4d transform = Eigen::Matrix4d::Identity();
  transform.topRows<3>() = applied_transform;
  Json frames = Json::array();
  for (const auto& [id, image] : model.images) {
    Eigen::Matrix4d world_from_camera = Eigen::Matrix4d::Identity();
    world_from_camera.topLeftCorner<3, 3>() = image.rotation.conjugate().toRotationMatrix();
    world_from_camera.topRightCorner<3, 1>() = image.Center();
    Eigen::Matrix4d pose = transform * FlipCameraAxes(world_from_camera);
    pose.topRightCorner<3, 1>() *= applied_scale;
    Json frame = ToJson(model.cameras.at(image.camera_id), EscapePath(file));
    frame["file_path"] = image.name;
    frame["transform_matrix"] = ToRows(pose, 4);
    frames.push_back(std::move(frame));
  }
  WriteJson(
      file,
      {{"frames", std::move(frames)}, {"applied_transform", ToRows(transform, 3)}, {"applied_scale", applied_scale}});
}

}  // namespace nrff
