// cameras.txt, images.txt, points3D.txt: one record a line (images: two), fields separated by spaces, '#' comments.
#include <algorithm>
#include <charconv>
#include <string>
#include <string_view>
#include <system_error>
#include <utility>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "sfm/colmap_io.h"

namespace nrff {
namespace {

// The fields of one line, taken from the left.
class Line {
 public:
  Line(std::string_view text, std::string where) : rest_(text), where_(std::move(where)) {}

  bool AtEnd() {
    SkipSpaces();
    return rest_.empty();
  }

  std::string_view Word(const char* what) {
    if (AtEnd()) throw InputError(where_ + ": the line ends where " + what + " is expected; the file is truncated");
    const std::string_view word = rest_.substr(0, rest_.find_first_of(" \t\r"));
    rest_.remove_prefix(word.size());
    return word;
  }

  template <typename T>
  T Number(const char* what) {
    const std::string_view word = Word(what);
    T value{};
    const auto [end, error] = std::from_chars(word.data(), word.data() + word.size(), value);
    if (error != std::errc() || end != word.data() + word.size()) {
      throw InputError(where_ + ": found \"" + EscapePath(std::string(word)) + "\" where " + what + " is expected");
    }
    return value;
  }

  // Everything up to the end of the line: names may hold spaces.
  std::string_view Rest(const char* what) {
    if (AtEnd()) throw InputError(where_ + ": the line ends where " + what + " is expected; the file is truncated");
    std::string_view rest = std::exchange(rest_, {});
    if (rest.ends_with('\r')) rest.remove_suffix(1);
    return rest;
  }

  const std::string& where() const { return where_; }

 private:
  void SkipSpaces() { rest_.remove_prefix(std::min(rest_.find_first_not_of(" \t\r"), rest_.size())); }

  std::string_view rest_;
  std::string where_;
};

class TextFile {
 public:
  explicit TextFile(const std::filesystem::path& path) : name_(EscapePath(path)), text_(ReadFile(path)) {}

  // The next line as it stands; false at the end of the file.
  bool Next(std::string_view& line) {
    if (at_ >= text_.size()) return false;
    const size_t end = std::min(text_.find('\n', at_), text_.size());
    line = std::string_view(text_).substr(at_, end - at_);
    at_ = end + 1;
    ++n_lines_;
    return true;
  }

  // The next line that is neither empty nor a comment.
  bool NextRecord(std::string_view& line) {
    while (Next(line)) {
      const size_t first = line.find_first_not_of(" \t\r");
      if (first != std::string_view::npos && line[first] != '#') return true;
    }
    return false;
  }

  std::string Where() const { return name_ + ", line " + std::to_string(n_lines_); }

 private:
  std::string name_;
  std::string text_;
  size_t at_ = 0;
  int n_lines_ = 0;
};

CameraModel ModelNamed(std::string_view name, const std::string& where) {
  for (int i = 0; i <= static_cast<int>(CameraModel::kThinPrismFisheye); ++i) {
    if (name == CameraModelName(static_cast<CameraModel>(i))) return static_cast<CameraModel>(i);
  }
  throw InputError(where + ": unknown camera model \"" + EscapePath(std::string(name)) +
                   "\"; known are COLMAP's from SIMPLE_PINHOLE to THIN_PRISM_FISHEYE");
}

void ReadCameras(const std::filesystem::path& path, ColmapModel& model) {
  TextFile file(path);
  for (std::string_view text; file.NextRecord(text);) {
    Line line(text, file.Where());
    ColmapCamera camera;
    camera.id = line.Number<uint32_t>("a camera id");
    camera.model = ModelNamed(line.Word("a camera model"), line.where());
    camera.width = line.Number<int>("a width");
    camera.height = line.Number<int>("a height");
    camera.params.resize(CameraModelParamCount(camera.model));
    for (double& param : camera.params) param = line.Number<double>("a camera parameter");
    AddCamera(model, std::move(camera), line.where());
  }
}

void ReadImages(const std::filesystem::path& path, ColmapModel& model) {
  TextFile file(path);
  for (std::string_view text; file.NextRecord(text);) {
    Line line(text, file.Where());
    ColmapImage image;
    image.id = line.Number<uint32_t>("an image id");
    for (double* q : {&image.rotation.w(), &image.rotation.x(), &image.rotation.y(), &image.rotation.z()}) {
      *q = line.Number<double>("a quaternion component");
    }
    for (int axis = 0; axis < 3; ++axis) image.translation[axis] = line.Number<double>("a translation component");
    image.camera_id = line.Number<uint32_t>("a camera id");
    image.name = line.Rest("an image name");
    // The second line holds the observations and is empty where there are none.
    if (std::string_view second; file.Next(second)) {
      Line observations(second, file.Where());
      while (!observations.AtEnd()) {
        ColmapObservation& observation = image.observations.emplace_back();
        observation.x = observations.Number<double>("an x coordinate");
        observation.y = observations.Number<double>("a y coordinate");
        observation.point_id = observations.Number<int64_t>("a point id");
      }
    }
    AddImage(model, std::move(image), line.where());
  }
}

void ReadPoints(const std::filesystem::path& path, ColmapModel& model) {
  TextFile file(path);
  for (std::string_view text; file.NextRecord(text);) {
    Line line(text, file.Where());
    const auto id = line.Number<uint64_t>("a point id");
    ColmapPoint point;
    for (int axis = 0; axis < 3; ++axis) point.position[axis] = line.Number<double>("a coordinate");
    for (uint8_t& channel : point.rgb) channel = line.Number<uint8_t>("a colour from 0 to 255");
    point.error_px = line.Number<double>("a reprojection error");
    while (!line.AtEnd()) {
      auto& [image_id, index] = point.track.emplace_back();
      image_id = line.Number<uint32_t>("an image id");
      index = line.Number<uint32_t>("an observation index");
    }
    AddPoint(model, id, std::move(point), line.where());
  }
}

// Shortest decimal form that reads back as the same number.
template <typename T>
void Append(std::string& text, T value) {
  char digits[32];
  if (!text.empty() && text.back() != '\n') text += ' ';
  text.append(digits, std::to_chars(digits, digits + sizeof(digits), value).ptr);
}

}  // namespace

ColmapModel ReadColmapText(const std::filesystem::path& dir) {
  ColmapModel model;
  ReadCameras(dir / "cameras.txt", model);
  ReadImages(dir / "images.txt", model);
  ReadPoints(dir / "points3D.txt", model);
  return model;
}

void WriteColmapText(const ColmapModel& model, const std::filesystem::path& dir) {
  std::filesystem::create_directories(dir);
  std::string cameras = "# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n";
  for (const auto& [id, camera] : model.cameras) {
    Append(cameras, id);
    cameras += std::string(" ") + CameraModelName(camera.model);
    Append(cameras, camera.width);
    Append(cameras, camera.height);
    for (double param : camera.params) Append(cameras, param);
    cameras += '\n';
  }
  WriteFileAtomically(dir / "cameras.txt", cameras);

  std::string images =
      "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME (camera from world)\n# X Y POINT3D_ID of every observation\n";
  for (const auto& [id, image] : model.images) {
    if (image.name.empty() || image.name.find_first_of("\r\n") != std::string::npos) {
      throw InputError(EscapePath(dir / "images.txt") + ": the image name \"" + EscapePath(image.name) +
                       "\" cannot be written as text; rename the image");
    }
    Append(images, id);
    for (double q : {image.rotation.w(), image.rotation.x(), image.rotation.y(), image.rotation.z()}) Append(images, q);
    for (double t : image.translation) Append(images, t);
    Append(images, image.camera_id);
    images += ' ' + image.name + '\n';
    for (const ColmapObservation& observation : image.observations) {
      Append(images, observation.x);
      Append(images, observation.y);
      Append(images, observation.point_id);
    }
    images += '\n';
  }
  WriteFileAtomically(dir / "images.txt", images);

  std::string points = "# POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID, POINT2D_IDX)\n";
  for (const auto& [id, point] : model.points) {
    Append(points, id);
    for (double x : point.position) Append(points, x);
    for (uint8_t channel : point.rgb) Append(points, static_cast<int>(channel));
    Append(points, point.error_px);
    for (const auto& [image_id, index] : point.track) {
      Append(points, image_id);
      Append(points, index);
    }
    points += '\n';
  }
  WriteFileAtomically(dir / "points3D.txt", points);
}

}  // namespace nrff
