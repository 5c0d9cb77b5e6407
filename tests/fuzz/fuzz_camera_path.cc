// Camera paths, of this project and of nerfstudio.
#include <cmath>

#include "render/camera_path.h"
#include "tests/fuzz/fuzz.h"

namespace nrff::fuzz {
namespace {

Scene SceneOfOneView() {
  Scene scene;
  scene.scene_from_world = {0, -2, 0, 1, 2, 0, 0, 2, 0, 0, 2, 3, 0, 0, 0, 1};
  View view;
  view.id = "000000";
  view.width = 40, view.height = 30;
  view.fx = view.fy = 50.5, view.cx = 20, view.cy = 15;
  view.scene_from_camera = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
  scene.views = {view};
  return scene;
}

}  // namespace

std::vector<std::string> Seeds() {
  return {"[{\"scene_from_camera\": [0, 0, 1, 3, 1, 0, 0, 2.5, 0, 1, 0, -1e-1, 0, 0, 0, 1]}]",
          "{\"camera_path\": [{\"camera_to_world\": [0, 0, 1, 3, 1, 0, 0, 2, 0, 1, 0, 1, 0, 0, 0, 1], \"fov\": 50.5},"
          " {\"camera_to_world\": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}],"
          " \"render_width\": 64, \"render_height\": 48}"};
}

}  // namespace nrff::fuzz

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace nrff;  // NOLINT(google-build-using-namespace)
  static const Scene scene = fuzz::SceneOfOneView();
  const std::filesystem::path file = fuzz::Folder() / "path.json";
  fuzz::Write("path.json", {reinterpret_cast<const char*>(data), size});
  const auto views = fuzz::ParseOrError(file, [&] { return ReadPath(file, scene, {}); });
  if (!views) return 0;
  for (const View& view : *views) {
    fuzz::Require(view.width > 0 && view.height > 0, "a frame has pixels");
    for (const double value : view.scene_from_camera) fuzz::Require(std::isfinite(value), "a frame's pose is finite");
    for (const double value : {view.fx, view.fy, view.cx, view.cy}) {
      fuzz::Require(std::isfinite(value), "a frame's intrinsics are finite");
    }
    fuzz::Require(view.fx > 0 && view.fy > 0, "a frame's focal length is positive");
  }
  return 0;
}
