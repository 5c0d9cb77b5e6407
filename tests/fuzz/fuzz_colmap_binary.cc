// COLMAP's binary models: cameras.bin, images.bin, points3D.bin.
#include "pipeline/files.h"
#include "tests/fuzz/fuzz.h"
#include "tests/fuzz/model_laws.h"
#include "tests/pose_fixture.h"

namespace nrff::fuzz {

std::vector<std::string> Seeds() {
  ColmapModel model = MakeModel({"000000", "a b.png"}, 64, 48, 0.05);
  model.cameras[9] = {9, CameraModel::kFullOpenCV, 8, 6, {9, 9, 4, 3, 0.1, 0.2, 0, 0, 0, 0, 0, 0.01}};
  while (model.points.size() > 3) model.points.erase(--model.points.end());
  for (auto& [id, image] : model.images) image.observations.resize(3);
  WriteColmapBinary(model, Folder());
  return {Join(
      {ReadFile(Folder() / "cameras.bin"), ReadFile(Folder() / "images.bin"), ReadFile(Folder() / "points3D.bin")})};
}

}  // namespace nrff::fuzz

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace nrff;  // NOLINT(google-build-using-namespace)
  const auto& folder = fuzz::Folder();
  const auto files = fuzz::Split(data, size, 3);
  fuzz::Write("cameras.bin", files[0]);
  fuzz::Write("images.bin", files[1]);
  fuzz::Write("points3D.bin", files[2]);
  const auto model = fuzz::ParseOrError(folder, [&] { return ReadColmapModel(folder); });
  if (!model) return 0;
  WriteColmapBinary(*model, folder / "written");
  fuzz::RequireSame(*model, ReadColmapModel(folder / "written"));
  return 0;
}
