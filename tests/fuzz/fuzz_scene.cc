// scene.json and depths.bin beside a pack of 64 KiB.
#include <cmath>

#include "pipeline/files.h"
#include "pipeline/scene.h"
#include "tests/fuzz/fuzz.h"

namespace nrff::fuzz {
namespace {

constexpr uint64_t kPackBytes = 1 << 16;

void RequireLaws(const Scene& scene) {
  const auto finite = [](const Mat4& matrix) {
    return std::all_of(matrix.begin(), matrix.end(), [](double value) { return std::isfinite(value); });
  };
  Require(finite(scene.scene_from_world), "scene_from_world is finite");
  const Mat4 world_from_scene = InverseSimilarity(scene.scene_from_world);
  Require(std::hypot(world_from_scene[0], world_from_scene[1], world_from_scene[2]) > 0,
          "scene_from_world has an inverse");
  for (const View& view : scene.views) {
    Require(finite(view.scene_from_camera), "a view's pose is finite");
    Require(view.width > 0 && view.height > 0, "a view has pixels");
    Require(view.pack_offset + view.PixelBytes() <= kPackBytes, "a view's pixels are in the pack");
    Require(!view.id.empty() && std::filesystem::path(view.id).filename() == view.id && view.id != "..",
            "a view's id is a file name");
  }
}

}  // namespace

std::vector<std::string> Seeds() {
  Scene scene;
  scene.name = "castle";
  scene.scene_from_world = {0, -2, 0, 1, 2, 0, 0, 2, 0, 0, 2, 3, 0, 0, 0, 1};
  for (int i = 0; i < 3; ++i) {
    View view;
    view.id = "00000" + std::to_string(i);
    view.name = "photo " + std::to_string(i) + ".jpg";
    view.split = i == 0 ? Split::kTest : Split::kTrain;
    view.width = 40, view.height = 30;
    view.pack_offset = 3600 * uint64_t(i);
    view.fx = view.fy = 50.5, view.cx = 20, view.cy = 15;
    view.scene_from_camera = {0, -1, 0, 0.5 * i, 1, 0, 0, 2, 0, 0, 1, 3, 0, 0, 0, 1};
    scene.views.push_back(view);
  }
  const std::vector<SparseDepth> depths = {{1, {0, 0.5, 1}, 0.01F}, {2, {1, 0.5, 1}, 0.02F}};
  Write(kPackFile, std::string(kPackBytes, '\0'));
  SaveScene(scene, Folder());
  SaveSparseDepths(depths, Folder());
  return {Join({ReadFile(Folder() / kSceneFile), ReadFile(Folder() / kDepthFile)})};
}

}  // namespace nrff::fuzz

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace nrff;  // NOLINT(google-build-using-namespace)
  const auto& folder = fuzz::Folder();
  static const bool has_pack = (fuzz::Write(kPackFile, std::string(fuzz::kPackBytes, '\0')), true);
  static_cast<void>(has_pack);
  const auto files = fuzz::Split(data, size, 2);
  fuzz::Write(kSceneFile, files[0]);
  fuzz::Write(kDepthFile, files[1]);
  const auto scene = fuzz::ParseOrError(folder / kSceneFile, [&] { return LoadScene(folder); });
  if (!scene) return 0;
  fuzz::RequireLaws(*scene);
  const Json read = ReadJson(folder / kSceneFile);
  SaveScene(*scene, folder);
  fuzz::RequireKept(read["views"], ReadJson(folder / kSceneFile)["views"]);
  const std::string written = ReadFile(folder / kSceneFile);
  SaveScene(LoadScene(folder), folder);
  fuzz::Require(ReadFile(folder / kSceneFile) == written, "a scene that is written is read as it was");
  const auto depths = fuzz::ParseOrError(folder / kDepthFile, [&] { return LoadSparseDepths(*scene, folder); });
  if (!depths) return 0;
  SaveSparseDepths(*depths, folder);
  fuzz::Require(ReadFile(folder / kDepthFile) == files[1], "depths are written as they were read");
  return 0;
}
