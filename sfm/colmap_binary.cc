// cameras.bin, images.bin, points3D.bin: little-endian, packed, a uint64 count first.
//
//   camera: u32 id, i32 model, u64 width, u64 height, f64 params[n of the model]
//   image:  u32 id, f64 qw qx qy qz tx ty tz, u32 camera id, name\0, u64 n, n × {f64 x, f64 y, u64 point id or ~0}
//   point:  u64 id, f64 x y z, u8 r g b, f64 error, u64 n, n × {u32 image id, u32 observation index}
#include <algorithm>
#include <bit>
#include <cstring>
#include <limits>
#include <string>
#include <type_traits>
#include <utility>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "sfm/colmap_io.h"

namespace nrff {
namespace {

static_assert(std::endian::native == std::endian::little, "COLMAP's binary files are little-endian");

class Reader {
 public:
  explicit Reader(const std::filesystem::path& path) : name_(EscapePath(path)), bytes_(ReadFile(path)) {}

  template <typename T>
  T Read() {
    static_assert(std::is_trivially_copyable_v<T>);
    Require(sizeof(T));
    T value;
    std::memcpy(&value, bytes_.data() + at_, sizeof(T));
    at_ += sizeof(T);
    return value;
  }

  // A count of records of at least `record_bytes` each, which the rest of the file must be able to hold.
  uint64_t ReadCount(uint64_t record_bytes) {
    const auto count = Read<uint64_t>();
    if (count > (bytes_.size() - at_) / record_bytes) {
      throw InputError(Where() + ": says " + std::to_string(count) + " records follow, but only " +
                       std::to_string(bytes_.size() - at_) + " bytes do; the file is truncated or damaged");
    }
    return count;
  }

  std::string ReadName() {
    const size_t end = bytes_.find('\0', at_);
    if (end == std::string::npos) Require(bytes_.size() - at_ + 1);
    std::string name = bytes_.substr(at_, end - at_);
    at_ = end + 1;
    return name;
  }

  void ExpectEnd() const {
    if (at_ != bytes_.size()) {
      throw InputError(Where() + ": " + std::to_string(bytes_.size() - at_) +
                       " bytes after the last record; the file is damaged");
    }
  }

  std::string Where() const { return name_ + ", byte " + std::to_string(at_); }

 private:
  void Require(size_t n_bytes) const {
    if (n_bytes > bytes_.size() - at_) {
      throw InputError(Where() + ": the file ends in the middle of a record; it is truncated, copy or export it again");
    }
  }

  std::string name_;
  std::string bytes_;
  size_t at_ = 0;
};

class Writer {
 public:
  template <typename T>
  void Write(T value) {
    static_assert(std::is_trivially_copyable_v<T>);
    bytes_.append(reinterpret_cast<const char*>(&value), sizeof(T));
  }
  void WriteName(const std::string& name) { bytes_.append(name.c_str(), name.size() + 1); }
  void Save(const std::filesystem::path& path) const { WriteFileAtomically(path, bytes_); }

 private:
  std::string bytes_;
};

int ToSide(uint64_t pixels) { return static_cast<int>(std::min<uint64_t>(pixels, std::numeric_limits<int>::max())); }

void ReadCameras(const std::filesystem::path& path, ColmapModel& model) {
  Reader reader(path);
  const uint64_t n = reader.ReadCount(4 + 4 + 8 + 8 + 3 * 8);
  for (uint64_t i = 0; i < n; ++i) {
    const std::string where = reader.Where();
    ColmapCamera camera;
    camera.id = reader.Read<uint32_t>();
    const auto number = reader.Read<int32_t>();
    if (number < 0 || number > static_cast<int>(CameraModel::kThinPrismFisheye)) {
      throw InputError(where + ": camera " + std::to_string(camera.id) + " has the unknown model number " +
                       std::to_string(number) + "; known are 0 (SIMPLE_PINHOLE) to 10 (THIN_PRISM_FISHEYE)");
    }
    camera.model = static_cast<CameraModel>(number);
    camera.width = ToSide(reader.Read<uint64_t>());
    camera.height = ToSide(reader.Read<uint64_t>());
    camera.params.resize(CameraModelParamCount(camera.model));
    for (double& param : camera.params) param = reader.Read<double>();
    AddCamera(model, std::move(camera), where);
  }
  reader.ExpectEnd();
}

void ReadImages(const std::filesystem::path& path, ColmapModel& model) {
  Reader reader(path);
  const uint64_t n = reader.ReadCount(4 + 7 * 8 + 4 + 1 + 8);
  for (uint64_t i = 0; i < n; ++i) {
    const std::string where = reader.Where();
    ColmapImage image;
    image.id = reader.Read<uint32_t>();
    for (double* q : {&image.rotation.w(), &image.rotation.x(), &image.rotation.y(), &image.rotation.z()}) {
      *q = reader.Read<double>();
    }
    for (int axis = 0; axis < 3; ++axis) image.translation[axis] = reader.Read<double>();
    image.camera_id = reader.Read<uint32_t>();
    image.name = reader.ReadName();
    image.observations.resize(reader.ReadCount(8 + 8 + 8));
    for (ColmapObservation& observation : image.observations) {
      observation.x = reader.Read<double>();
      observation.y = reader.Read<double>();
      observation.point_id = static_cast<int64_t>(reader.Read<uint64_t>());  // ~0 becomes -1
    }
    AddImage(model, std::move(image), where);
  }
  reader.ExpectEnd();
}

void ReadPoints(const std::filesystem::path& path, ColmapModel& model) {
  Reader reader(path);
  const uint64_t n = reader.ReadCount(8 + 3 * 8 + 3 + 8 + 8);
  for (uint64_t i = 0; i < n; ++i) {
    const std::string where = reader.Where();
    const auto id = reader.Read<uint64_t>();
    ColmapPoint point;
    for (int axis = 0; axis < 3; ++axis) point.position[axis] = reader.Read<double>();
    for (uint8_t& channel : point.rgb) channel = reader.Read<uint8_t>();
    point.error_px = reader.Read<double>();
    point.track.resize(reader.ReadCount(4 + 4));
    for (auto& [image_id, index] : point.track) {
      image_id = reader.Read<uint32_t>();
      index = reader.Read<uint32_t>();
    }
    AddPoint(model, id, std::move(point), where);
  }
  reader.ExpectEnd();
}

}  // namespace

ColmapModel ReadColmapBinary(const std::filesystem::path& dir) {
  ColmapModel model;
  ReadCameras(dir / "cameras.bin", model);
  ReadImages(dir / "images.bin", model);
  ReadPoints(dir / "points3D.bin", model);
  return model;
}

void WriteColmapBinary(const ColmapModel& model, const std::filesystem::path& dir) {
  std::filesystem::create_directories(dir);
  Writer cameras;
  cameras.Write<uint64_t>(model.cameras.size());
  for (const auto& [id, camera] : model.cameras) {
    cameras.Write(id);
    cameras.Write(static_cast<int32_t>(camera.model));
    cameras.Write<uint64_t>(camera.width);
    cameras.Write<uint64_t>(camera.height);
    for (double param : camera.params) cameras.Write(param);
  }
  cameras.Save(dir / "cameras.bin");

  Writer images;
  images.Write<uint64_t>(model.images.size());
  for (const auto& [id, image] : model.images) {
    images.Write(id);
    for (double q : {image.rotation.w(), image.rotation.x(), image.rotation.y(), image.rotation.z()}) images.Write(q);
    for (double t : image.translation) images.Write(t);
    images.Write(image.camera_id);
    images.WriteName(image.name);
    images.Write<uint64_t>(image.observations.size());
    for (const ColmapObservation& observation : image.observations) {
      images.Write(observation.x);
      images.Write(observation.y);
      images.Write(observation.point_id);
    }
  }
  images.Save(dir / "images.bin");

  Writer points;
  points.Write<uint64_t>(model.points.size());
  for (const auto& [id, point] : model.points) {
    points.Write(id);
    for (double x : point.position) points.Write(x);
    for (uint8_t channel : point.rgb) points.Write(channel);
    points.Write(point.error_px);
    points.Write<uint64_t>(point.track.size());
    for (const auto& [image_id, index] : point.track) {
      points.Write(image_id);
      points.Write(index);
    }
  }
  points.Save(dir / "points3D.bin");
}

}  // namespace nrff
