#include "pipeline/scene.h"

#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <set>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"

namespace nrff {
namespace fs = std::filesystem;
namespace {

constexpr const char* kSplitNames[] = {"train", "test"};
constexpr const char* kBackgroundNames[] = {"none", "white", "black"};

template <typename Enum, size_t n>
Enum ParseName(const Json& value, const char* key, const char* const (&names)[n], const std::string& where) {
  const auto text = Get<std::string>(value, key, where);
  for (size_t i = 0; i < n; ++i) {
    if (text == names[i]) return static_cast<Enum>(i);
  }
  std::string known;
  for (const char* name : names) known += (known.empty() ? "" : ", ") + std::string(name);
  throw CorruptError(where + ": \"" + key + "\" is \"" + text + "\", expected one of " + known +
                     ": run the stage that wrote it again");
}

// Rows of the upper 3×3 orthogonal with one common length > 0, right-handed, all finite, last row 0 0 0 1.
void CheckSimilarity(const Mat4& m, bool rigid, const std::string& where) {
  for (const double value : m) {
    if (!std::isfinite(value)) throw InputError(where + " has a number that is not finite: run the pose stage again");
  }
  const auto row = [&](int i) { return Vec3{m[i * 4], m[i * 4 + 1], m[i * 4 + 2]}; };
  const auto dot = [](const Vec3& a, const Vec3& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; };
  const Vec3 a = row(0), b = row(1), c = row(2);
  const double scale2 = dot(a, a);
  const double determinant =
      a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0]);
  constexpr double kTolerance = 1e-5;
  const double largest_skew = std::max({std::abs(dot(a, b)), std::abs(dot(a, c)), std::abs(dot(b, c)),
                                        std::abs(dot(b, b) - scale2), std::abs(dot(c, c) - scale2)});
  if (!(scale2 > 0) || !std::isfinite(scale2) || !(largest_skew <= kTolerance * scale2) || !(determinant > 0) ||
      (rigid && std::abs(scale2 - 1) > kTolerance)) {
    throw InputError(where + " is not a right-handed " + (rigid ? "rigid transform" : "similarity") +
                     ": run the pose stage again");
  }
  if (m[12] != 0 || m[13] != 0 || m[14] != 0 || m[15] != 1)
    throw InputError(where + " does not end with the row 0 0 0 1");
}

}  // namespace

const char* BackgroundName(Background background) { return kBackgroundNames[static_cast<int>(background)]; }

Background ParseBackground(const Json& json, const std::string& where) {
  return ParseName<Background>(json, "background", kBackgroundNames, where);
}

std::vector<int> Scene::ViewsOf(Split split) const {
  std::vector<int> indices;
  for (size_t i = 0; i < views.size(); ++i) {
    if (views[i].split == split) indices.push_back(static_cast<int>(i));
  }
  return indices;
}

double ExposureSpread(const Scene& scene) {
  double sum = 0, squares = 0, n = 0;
  for (const View& view : scene.views) {
    if (view.split != Split::kTrain) continue;
    double ev = 0;
    for (const double gain : view.colour_gain) ev += kDisplayGamma * std::log2(gain) / 3;
    sum += ev;
    squares += ev * ev;
    ++n;
  }
  return n == 0 ? 0 : std::sqrt(std::max(0., squares / n - sum * sum / (n * n)));
}

void SaveScene(const Scene& scene, const fs::path& dir) {
  Json views = Json::array();
  for (const View& view : scene.views) {
    views.push_back({{"id", view.id},
                     {"name", view.name},
                     {"split", kSplitNames[static_cast<int>(view.split)]},
                     {"width", view.width},
                     {"height", view.height},
                     {"channels", view.channels},
                     {"masked", view.masked},
                     {"pack_offset", view.pack_offset},
                     {"fx", view.fx},
                     {"fy", view.fy},
                     {"cx", view.cx},
                     {"cy", view.cy},
                     {"scene_from_camera", view.scene_from_camera},
                     {"colour_gain", view.colour_gain}});
  }
  WriteJson(dir / kSceneFile, {{"schema_version", kSceneSchemaVersion},
                               {"name", scene.name},
                               {"background", BackgroundName(scene.background)},
                               {"unbounded", scene.unbounded},
                               {"aabb_min", scene.aabb_min},
                               {"aabb_max", scene.aabb_max},
                               {"near", scene.near},
                               {"far", scene.far},
                               {"scene_from_world", scene.scene_from_world},
                               {"views", views}});
}

Scene LoadScene(const fs::path& dir) {
  const fs::path path = dir / kSceneFile;
  const std::string where = EscapePath(path);
  const Json json = ReadJson(path);
  CheckSchemaVersion(json, kSceneSchemaVersion, where);
  Scene scene;
  scene.name = Get<std::string>(json, "name", where);
  scene.background = ParseBackground(json, where);
  scene.unbounded = Get<bool>(json, "unbounded", where);
  scene.aabb_min = Get<Vec3>(json, "aabb_min", where);
  scene.aabb_max = Get<Vec3>(json, "aabb_max", where);
  scene.near = Get<double>(json, "near", where);
  scene.far = Get<double>(json, "far", where);
  scene.scene_from_world = Get<Mat4>(json, "scene_from_world", where);
  CheckSimilarity(scene.scene_from_world, false, where + ": scene_from_world");
  for (int i = 0; i < 3; ++i) {
    if (!std::isfinite(scene.aabb_min[i]) || !std::isfinite(scene.aabb_max[i]) ||
        !(scene.aabb_min[i] < scene.aabb_max[i])) {
      throw InputError(where + ": the box is empty or not finite: run the pose stage again");
    }
  }
  if (!(scene.near >= 0) || !(scene.far > scene.near) || !std::isfinite(scene.far)) {
    throw InputError(where + ": near and far are not 0 ≤ near < far: run the pose stage again");
  }
  std::error_code error;
  const uint64_t pack_bytes = fs::file_size(dir / kPackFile, error);
  if (error) throw CorruptError(EscapePath(dir / kPackFile) + " is missing: run the pose stage again");
  std::set<std::string> ids;
  for (const Json& item : Get<std::vector<Json>>(json, "views", where)) {
    View view;
    view.id = Get<std::string>(item, "id", where);
    const std::string view_where = where + ": view " + EscapePath(view.id);
    if (!IsFileName(view.id)) {
      throw CorruptError(view_where +
                         " has an id that is no file name, expected one as 000012: run the pose stage again");
    }
    view.name = Get<std::string>(item, "name", view_where);
    view.split = ParseName<Split>(item, "split", kSplitNames, view_where);
    view.width = Get<int>(item, "width", view_where);
    view.height = Get<int>(item, "height", view_where);
    view.channels = Get<int>(item, "channels", view_where);
    view.masked = Get<bool>(item, "masked", view_where);
    view.pack_offset = Get<uint64_t>(item, "pack_offset", view_where);
    view.fx = Get<double>(item, "fx", view_where);
    view.fy = Get<double>(item, "fy", view_where);
    view.cx = Get<double>(item, "cx", view_where);
    view.cy = Get<double>(item, "cy", view_where);
    view.scene_from_camera = Get<Mat4>(item, "scene_from_camera", view_where);
    CheckSimilarity(view.scene_from_camera, true, view_where + ": scene_from_camera");
    view.colour_gain = Get<Vec3>(item, "colour_gain", view_where);
    for (const double gain : view.colour_gain) {
      if (!(gain > 0) || !std::isfinite(gain)) {
        throw CorruptError(view_where + " has a colour gain that is not finite and positive: run the pose stage again");
      }
    }
    if (!ids.insert(view.id).second) throw CorruptError(view_where + " appears twice");
    if (view.width < 1 || view.height < 1 || (view.channels != 3 && view.channels != 4)) {
      throw CorruptError(view_where + " is " + std::to_string(view.width) + "×" + std::to_string(view.height) +
                         " with " + std::to_string(view.channels) + " channels, expected at least 1×1 with 3 or 4");
    }
    if (view.masked && view.channels != 4) {
      throw CorruptError(view_where + " is masked but has no alpha channel: run the pose stage again");
    }
    if (view.pack_offset > pack_bytes || view.PixelBytes() > pack_bytes - view.pack_offset) {
      throw CorruptError(view_where + " lies outside " + kPackFile + " (" + std::to_string(pack_bytes) + " bytes)");
    }
    if (!(view.fx > 0) || !(view.fy > 0) || !std::isfinite(view.fx) || !std::isfinite(view.fy) ||
        !std::isfinite(view.cx) || !std::isfinite(view.cy)) {
      throw InputError(view_where + " has intrinsics that are not finite and positive: run the pose stage again");
    }
    scene.views.push_back(std::move(view));
  }
  return scene;
}

void SaveSparseDepths(const std::vector<SparseDepth>& depths, const fs::path& dir) {
  WriteFileAtomically(dir / kDepthFile,
                      {reinterpret_cast<const char*>(depths.data()), depths.size() * sizeof(SparseDepth)});
}

std::vector<SparseDepth> LoadSparseDepths(const Scene& scene, const fs::path& dir) {
  const fs::path path = dir / kDepthFile;
  const auto damaged = [&](const std::string& what) {
    return CorruptError(EscapePath(path) + " " + what + ": run the pose stage again");
  };
  if (!fs::exists(path)) throw damaged("is missing");
  const std::string bytes = ReadFile(path);
  if (bytes.size() % sizeof(SparseDepth) != 0) throw damaged("ends within a record");
  std::vector<SparseDepth> depths(bytes.size() / sizeof(SparseDepth));
  if (!bytes.empty()) std::memcpy(depths.data(), bytes.data(), bytes.size());
  for (size_t i = 0; i < depths.size(); ++i) {
    const SparseDepth& d = depths[i];
    const bool finite = std::isfinite(d.position[0]) && std::isfinite(d.position[1]) && std::isfinite(d.position[2]);
    if (!finite || !(d.sigma > 0) || !std::isfinite(d.sigma)) {
      throw damaged("has a position or deviation that cannot be in record " + std::to_string(i));
    }
    if (d.view >= scene.views.size() || scene.views[d.view].split != Split::kTrain) {
      throw damaged("names view " + std::to_string(d.view) + " in record " + std::to_string(i) +
                    ", which is not a training view");
    }
  }
  return depths;
}

ImagePack::ImagePack(const fs::path& dir) {
  const fs::path path = dir / kPackFile;
  const int fd = open(path.c_str(), O_RDONLY | O_CLOEXEC);
  if (fd < 0) throw InputError("cannot open " + EscapePath(path) + ": " + std::strerror(errno));
  struct stat info {};
  const bool known = fstat(fd, &info) == 0;
  size_ = known ? static_cast<uint64_t>(info.st_size) : 0;
  void* map = size_ > 0 ? mmap(nullptr, size_, PROT_READ, MAP_SHARED, fd, 0) : nullptr;
  const int map_error = errno;
  close(fd);
  if (!known || map == MAP_FAILED)
    throw ResourceError("cannot map " + EscapePath(path) + ": " + std::strerror(map_error));
  data_ = static_cast<const uint8_t*>(map);
}

ImagePack::~ImagePack() {
  if (data_ != nullptr) munmap(const_cast<uint8_t*>(data_), size_);
}

Mat4 Multiply(const Mat4& a, const Mat4& b) {
  Mat4 product{};
  for (int i = 0; i < 4; ++i) {
    for (int j = 0; j < 4; ++j) {
      for (int k = 0; k < 4; ++k) product[i * 4 + j] += a[i * 4 + k] * b[k * 4 + j];
    }
  }
  return product;
}

Mat4 InverseSimilarity(const Mat4& m) {
  const double scale2 = m[0] * m[0] + m[1] * m[1] + m[2] * m[2];
  Mat4 inverse{};
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) inverse[i * 4 + j] = m[j * 4 + i] / scale2;
  }
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) inverse[i * 4 + 3] -= inverse[i * 4 + j] * m[j * 4 + 3];
  }
  inverse[15] = 1;
  return inverse;
}

}  // namespace nrff
