// COLMAP's text models: cameras.txt, images.txt, points3D.txt.
#include "pipeline/files.h"
#include "tests/fuzz/fuzz.h"
#include "tests/fuzz/model_laws.h"
#include "tests/pose_fixture.h"

namespace nrff::fuzz {

std::vector<std::string> Seeds() {
  ColmapModel model = MakeModel({"000000", "a b.png"}, 64, 48, 0.05);
  model.cameras[9] = {9, CameraModel::kThinPrismFisheye, 8, 6, {9, 9, 4, 3, 0.1, 0.2, 0, 0, 0, 0, 0, 0.01}};
  while (model.points.size() > 2) model.points.erase(--model.points.end());
  for (auto& [id, image] : model.images) image.observations.resize(2);
  WriteColmapText(model, Folder());
  return {Join(
      {ReadFile(Folder() / "cameras.txt"), ReadFile(Folder() / "images.txt"), ReadFile(Folder() / "points3D.txt")})};
}

}  // namespace nrff::fuzz

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace nrff;  // NOLINT(google-build-using-namespace)
  const auto& folder = fuzz::Folder();
  const auto files = fuzz::Split(data, size, 3);
  fuzz::Write("cameras.txt", files[0]);
  fuzz::Write("images.txt", files[1]);
  fuzz::Write("points3D.txt", files[2]);
  const auto model = fuzz::ParseOrError(folder, [&] { return ReadColmapModel(folder); });
  if (!model) return 0;
  WriteColmapText(*model, folder / "text");
  fuzz::RequireSame(*model, ReadColmapModel(folder / "text"));
  WriteColmapBinary(*model, folder / "binary");
  fuzz::RequireSame(*model, ReadColmapModel(folder / "binary"));
  return 0;
}
