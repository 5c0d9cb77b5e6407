// The volume that a Tanks & Temples scene is evaluated in.
#include "sfm/crop_volume.h"
#include "tests/fuzz/fuzz.h"

namespace nrff::fuzz {

std::vector<std::string> Seeds() {
  return {R"({"class_name": "SelectionPolygonVolume", "orthogonal_axis": "Y", "axis_min": -0.5, "axis_max": 2e0,
 "bounding_polygon": [[0, 0, 0], [1, 0, 0.5], [1, 0, 1]], "version_major": 1})"};
}

}  // namespace nrff::fuzz

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace nrff;  // NOLINT(google-build-using-namespace)
  const std::filesystem::path file = fuzz::Folder() / "scene.json";
  fuzz::Write("scene.json", {reinterpret_cast<const char*>(data), size});
  const auto volume = fuzz::ParseOrError(file, [&] { return ReadCropVolume(file); });
  if (!volume) return 0;
  fuzz::Require(volume->axis >= 0 && volume->axis < 3 && volume->least < volume->most, "a volume has an extent");
  for (const Eigen::Vector3d& corner : volume->Corners()) fuzz::Require(corner.allFinite(), "corners are finite");
  return 0;
}
