#include "render/camera_path.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <numbers>
#include <string>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"
#include "pipeline/statistics.h"

namespace nrff {
namespace {

constexpr double kPi = std::numbers::pi;

Vec3 Sub(const Vec3& a, const Vec3& b) { return {a[0] - b[0], a[1] - b[1], a[2] - b[2]}; }
Vec3 AddScaled(const Vec3& a, double s, const Vec3& b) { return {a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]}; }
double Dot(const Vec3& a, const Vec3& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
Vec3 Cross(const Vec3& a, const Vec3& b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}
Vec3 Unit(const Vec3& a) { return AddScaled({0, 0, 0}, 1 / std::sqrt(Dot(a, a)), a); }
Vec3 Column(const Mat4& m, int c) { return {m[c], m[4 + c], m[8 + c]}; }

std::vector<Mat4> TrainingPoses(const Scene& scene) {
  std::vector<Mat4> poses;
  for (const int i : scene.ViewsOf(Split::kTrain)) poses.push_back(scene.views[i].scene_from_camera);
  if (poses.empty()) throw InputError("the scene " + scene.name + " has no training views to lay a camera path along");
  return poses;
}

// Median over the training poses of a number each has.
template <typename Measure>
double MedianOf(const std::vector<Mat4>& poses, Measure&& measure) {
  std::vector<double> values;
  values.reserve(poses.size());
  for (const Mat4& pose : poses) values.push_back(measure(pose));
  return Median(std::move(values));
}

// Looks from `position` at `target`, +z up; OpenCV axes.
Mat4 LookAt(const Vec3& position, const Vec3& target) {
  const Vec3 line = Sub(target, position);
  if (!(Dot(line, line) > 1e-16)) {
    throw InputError(
        "the camera path goes through the point it looks at: the training cameras all stand in one place; "
        "give a path file");
  }
  const Vec3 forward = Unit(line);
  Vec3 right = Cross(forward, {0, 0, 1});
  right = Dot(right, right) > 1e-12 ? Unit(right) : Vec3{1, 0, 0};  // straight up or down: any right will do
  const Vec3 down = Cross(forward, right);
  return {right[0], down[0], forward[0], position[0], right[1], down[1], forward[1], position[1],
          right[2], down[2], forward[2], position[2], 0,        0,       0,          1};
}

std::string FrameId(int frame) {
  char id[16];
  std::snprintf(id, sizeof(id), "%06d", frame);
  return id;
}

// A frame of the wanted size that sees as much in height as the first training view.
View Frame(const Scene& scene, const PathOptions& options, int frame, const Mat4& scene_from_camera) {
  const std::vector<int> train = scene.ViewsOf(Split::kTrain);
  if (train.empty()) throw InputError("the scene " + scene.name + " has no training view to take intrinsics from");
  const View& like = scene.views[train.front()];
  View view = like;
  view.id = FrameId(frame);
  view.name = view.id;
  view.split = Split::kTest;
  view.channels = 3;
  view.pack_offset = 0;
  view.scene_from_camera = scene_from_camera;
  if (options.width > 0) view.width = options.width;
  if (options.height > 0) view.height = options.height;
  const double scale = static_cast<double>(view.height) / like.height;
  view.fx = like.fx * scale;
  view.fy = like.fy * scale;
  view.cx = like.cx * scale + 0.5 * (view.width - like.width * scale);
  view.cy = like.cy * scale;
  return view;
}

void AppendNumbers(const Json& value, std::vector<double>& numbers) {
  if (value.is_array()) {
    for (const Json& entry : value) AppendNumbers(entry, numbers);
  } else {
    numbers.push_back(value.is_number() ? value.get<double>() : std::nan(""));
  }
}

// 16 numbers in a row, as nerfstudio writes them, or four rows of four. What is not a number becomes NaN, which
// RigidPart refuses.
Mat4 MatrixAt(const Json& frame, const char* key, const std::string& where) {
  std::vector<double> numbers;
  if (frame.is_object() && frame.contains(key)) AppendNumbers(frame[key], numbers);
  if (numbers.size() != 16) {
    throw InputError(where + " has " + std::to_string(numbers.size()) + " numbers under \"" + key +
                     "\"; expected 16, row-major");
  }
  Mat4 m;
  std::copy(numbers.begin(), numbers.end(), m.begin());
  return m;
}

// The image size a nerfstudio file may give.
int PixelsAt(const Json& json, const char* key, const std::string& name) {
  if (!json.contains(key)) return 0;
  const Json& value = json[key];
  if (!value.is_number_integer() || value.get<int64_t>() <= 0 || value.get<int64_t>() > 65536) {
    throw InputError("\"" + std::string(key) + "\" of the camera path " + name +
                     " must be a number of pixels from 1 to 65536");
  }
  return value.get<int>();
}

// Divides a uniform scale out of the rotation part and checks that what is left is a rotation.
Mat4 RigidPart(Mat4 m, const std::string& where) {
  const double scale = std::cbrt(Dot(Cross(Column(m, 0), Column(m, 1)), Column(m, 2)));
  double worst = 0;
  for (int a = 0; a < 3; ++a) {
    for (int k = 0; k < 3; ++k) m[4 * k + a] /= scale;
  }
  for (int a = 0; a < 3; ++a) {
    for (int b = 0; b < 3; ++b) worst = std::max(worst, std::abs(Dot(Column(m, a), Column(m, b)) - (a == b ? 1 : 0)));
  }
  const double bottom = std::max({std::abs(m[12]), std::abs(m[13]), std::abs(m[14]), std::abs(m[15] - 1)});
  const bool finite = std::all_of(m.begin(), m.end(), [](double x) { return std::isfinite(x); });
  if (!finite || !(scale > 0) || !(worst < 1e-3) || !(bottom < 1e-6)) {
    throw InputError(where +
                     " is not a camera pose: expected a right-handed rotation, a finite position and the last "
                     "row 0 0 0 1");
  }
  return m;
}

View NerfstudioFrame(const Json& entry, const Scene& scene, const PathOptions& options, int frame,
                     const std::string& where) {
  Mat4 world_from_camera = MatrixAt(entry, "camera_to_world", where);
  for (int k = 0; k < 3; ++k) {  // OpenGL's axes (y up, z back) → OpenCV's
    world_from_camera[4 * k + 1] = -world_from_camera[4 * k + 1];
    world_from_camera[4 * k + 2] = -world_from_camera[4 * k + 2];
  }
  View view = Frame(scene, options, frame, RigidPart(Multiply(scene.scene_from_world, world_from_camera), where));
  if (entry.contains("fov")) {
    const double degrees = entry["fov"].is_number() ? entry["fov"].get<double>() : 0;
    if (!(degrees > 0 && degrees < 180))
      throw InputError(where + ": \"fov\" must be a number of degrees between 0 and 180");
    view.fx = view.fy = 0.5 * view.height / std::tan(0.5 * degrees * kPi / 180);
    if (!std::isfinite(view.fx)) throw InputError(where + ": \"fov\" is too small a number of degrees");
    view.cx = 0.5 * view.width;
    view.cy = 0.5 * view.height;
  }
  return view;
}

Json ReadPathJson(const std::filesystem::path& file) {
  try {
    return ReadJson(file);
  } catch (const Error& error) {  // a file of the user's, not a damaged artifact
    throw InputError(error.what());
  }
}

}  // namespace

Vec3 FocusPoint(const Scene& scene) {
  // Normal equations of Σ ‖(I − d dᵀ)(p − o)‖² over cameras at o that look along d.
  double a[3][3] = {}, b[3] = {};
  for (const Mat4& pose : TrainingPoses(scene)) {
    const Vec3 d = Column(pose, 2), o = Column(pose, 3);
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) {
        const double projection = (i == j ? 1 : 0) - d[i] * d[j];
        a[i][j] += projection;
        b[i] += projection * o[j];
      }
    }
  }
  const Vec3 rows[3] = {{a[0][0], a[0][1], a[0][2]}, {a[1][0], a[1][1], a[1][2]}, {a[2][0], a[2][1], a[2][2]}};
  const Vec3 cofactors[3] = {Cross(rows[1], rows[2]), Cross(rows[2], rows[0]), Cross(rows[0], rows[1])};
  const double determinant = Dot(rows[0], cofactors[0]), trace = a[0][0] + a[1][1] + a[2][2];
  Vec3 focus;
  for (int k = 0; k < 3; ++k) {
    const double low = scene.aabb_min[k], high = scene.aabb_max[k];
    focus[k] = 0.5 * (low + high);
    if (determinant > 1e-6 * trace * trace * trace) {
      const double x = (cofactors[0][k] * b[0] + cofactors[1][k] * b[1] + cofactors[2][k] * b[2]) / determinant;
      focus[k] = std::clamp(x, low, high);
    }
  }
  return focus;
}

std::vector<View> OrbitPath(const Scene& scene, const PathOptions& options) {
  const std::vector<Mat4> poses = TrainingPoses(scene);
  const Vec3 focus = FocusPoint(scene);
  const double radius = MedianOf(poses, [&](const Mat4& m) { return std::hypot(m[3] - focus[0], m[7] - focus[1]); });
  const double height = MedianOf(poses, [](const Mat4& m) { return m[11]; });
  const double start = std::atan2(poses.front()[7] - focus[1], poses.front()[3] - focus[0]);
  std::vector<View> views;
  for (int frame = 0; frame < options.n_frames; ++frame) {
    const double angle = start + 2 * kPi * frame / options.n_frames;
    const Vec3 position{focus[0] + radius * std::cos(angle), focus[1] + radius * std::sin(angle), height};
    views.push_back(Frame(scene, options, frame, LookAt(position, focus)));
  }
  return views;
}

std::vector<View> SpiralPath(const Scene& scene, const PathOptions& options) {
  const std::vector<Mat4> poses = TrainingPoses(scene);
  const Vec3 focus = FocusPoint(scene);
  Vec3 center;
  for (int k = 0; k < 3; ++k) center[k] = MedianOf(poses, [k](const Mat4& m) { return m[4 * k + 3]; });
  const Mat4 middle = LookAt(center, focus);
  Vec3 half_axes;
  for (int axis = 0; axis < 3; ++axis) {
    half_axes[axis] = 0.5 * MedianOf(poses, [&](const Mat4& m) {
                        return std::abs(Dot(Sub(Column(m, 3), center), Column(middle, axis)));
                      });
  }
  std::vector<View> views;
  for (int frame = 0; frame < options.n_frames; ++frame) {
    const double angle = 4 * kPi * frame / options.n_frames;
    const double offsets[3] = {std::cos(angle), std::sin(angle), std::sin(0.5 * angle)};
    Vec3 position = center;
    for (int axis = 0; axis < 3; ++axis) {
      position = AddScaled(position, half_axes[axis] * offsets[axis], Column(middle, axis));
    }
    views.push_back(Frame(scene, options, frame, LookAt(position, focus)));
  }
  return views;
}

std::vector<View> ReadPath(const std::filesystem::path& file, const Scene& scene, const PathOptions& options) {
  const std::string name = EscapePath(file);
  const Json json = ReadPathJson(file);
  const bool nerfstudio = json.is_object() && json.contains("camera_path");
  const Json& frames = nerfstudio ? json["camera_path"] : json;
  if (!frames.is_array() || frames.empty()) {
    throw InputError("the camera path " + name +
                     " holds no list of frames; expected [{\"scene_from_camera\": [16 numbers]}, "
                     "…] or nerfstudio's {\"camera_path\": […]}");
  }
  PathOptions size = options;
  if (nerfstudio) {
    if (size.width == 0) size.width = PixelsAt(json, "render_width", name);
    if (size.height == 0) size.height = PixelsAt(json, "render_height", name);
  }
  std::vector<View> views;
  for (size_t i = 0; i < frames.size(); ++i) {
    const int frame = static_cast<int>(i);
    const std::string where = "frame " + std::to_string(i) + " of the camera path " + name;
    views.push_back(nerfstudio
                        ? NerfstudioFrame(frames[i], scene, size, frame, where)
                        : Frame(scene, size, frame, RigidPart(MatrixAt(frames[i], "scene_from_camera", where), where)));
  }
  return views;
}

}  // namespace nrff
