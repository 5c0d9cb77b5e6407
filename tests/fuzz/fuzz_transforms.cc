// transforms.json beside three photos, as NeRF-synthetic, instant-ngp and nerfstudio write it.
#include "pipeline/json.h"
#include "sfm/transforms_json.h"
#include "tests/fuzz/fuzz.h"
#include "tests/fuzz/model_laws.h"
#include "tests/photo_fixtures.h"

namespace nrff::fuzz {
namespace {

constexpr char kFile[] = "transforms.json";

void WritePhotos(const std::filesystem::path& folder) {
  WritePhoto(folder / "a.png", {.width = 8, .height = 6, .channels = 4});
  WritePhoto(folder / "b.png", {.width = 8, .height = 6});
  WritePhoto(folder / "c.jpg", {.width = 8, .height = 6}, "jpeg");
}

// Poses of the file written for what was read are those that were read, to rounding.
void RequireSamePoses(const ColmapModel& read, const ColmapModel& again) {
  Require(read.images.size() == again.images.size(), "as many frames are read as were written");
  for (const auto& [id, image] : read.images) {
    const ColmapImage& other = again.images.at(id);
    Require(image.name == other.name, "frames keep their photos");
    Require((image.rotation.toRotationMatrix() - other.rotation.toRotationMatrix()).norm() < 1e-12,
            "frames keep their rotations");
    Require((image.translation - other.translation).norm() <= 1e-12 * image.translation.norm(),
            "frames keep their translations");
  }
}

}  // namespace

std::vector<std::string> Seeds() {
  const Json pose = {{0, 0, 1, 3.5}, {1, 0, 0, -0.5}, {0, 1, 0, 1e-3}, {0, 0, 0, 1}};
  const auto frames = [&](const std::string& a, const std::string& b) {
    return Json{{{"file_path", a}, {"transform_matrix", pose}}, {{"file_path", b}, {"transform_matrix", pose}}};
  };
  const Json synthetic = {{"camera_angle_x", 0.69}, {"frames", frames("./a", "./b")}};
  const Json instant_ngp = {{"fl_x", 9.5}, {"fl_y", 9.25}, {"cx", 4},         {"cy", 3},
                            {"w", 8.0},    {"h", 6.0},     {"k1", 0.1},       {"k2", -0.1},
                            {"p1", 0.001}, {"p2", 0.002},  {"aabb_scale", 4}, {"frames", frames("a.png", "gone.png")}};
  Json nerfstudio = {{"camera_model", "OPENCV_FISHEYE"},
                     {"fl_x", 9},
                     {"k1", 0.1},
                     {"k4", 0.01},
                     {"frames", frames("a.png", "c.jpg")},
                     {"applied_transform", {{0, 1, 0, 0}, {0, 0, 1, 0}, {1, 0, 0, 2}}},
                     {"applied_scale", 0.5},
                     {"train_filenames", {"a.png"}},
                     {"test_filenames", {"c.jpg"}}};
  nerfstudio["frames"][1].update(
      {{"w", 16}, {"h", 12}, {"camera_model", "FULL_OPENCV"}, {"k6", 0.1}, {"camera_angle_y", 1}});
  return {synthetic.dump(), instant_ngp.dump(), nerfstudio.dump()};
}

}  // namespace nrff::fuzz

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace nrff;  // NOLINT(google-build-using-namespace)
  const auto& folder = fuzz::Folder();
  static const bool has_photos = (fuzz::WritePhotos(folder), true);
  static_cast<void>(has_photos);
  fuzz::Write(fuzz::kFile, {reinterpret_cast<const char*>(data), size});
  const auto read = [&] { return ReadTransformsSource(folder).value(); };
  const auto source = fuzz::ParseOrError(folder, read);
  if (!source) return 0;
  fuzz::RequireUsable(*source);
  const auto again = fuzz::ParseOrError(folder, [&] {
    WriteTransforms(*source->model, folder / fuzz::kFile);
    return read();
  });
  if (again) fuzz::RequireSamePoses(*source->model, *again->model);
  return 0;
}
