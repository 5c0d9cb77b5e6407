// NSVF's layout: intrinsics.txt, two poses and bbox.txt, beside two photos.
#include "sfm/nsvf.h"
#include "tests/fuzz/fuzz.h"
#include "tests/fuzz/model_laws.h"
#include "tests/photo_fixtures.h"

namespace nrff::fuzz {

std::vector<std::string> Seeds() {
  const std::string pose = "1 0 0 0.5\n0 1 0 -2\n0 0 1 3e-1\n0 0 0 1\n", box = "-1 -1 -1 1 1 1 0.4\n";
  return {Join({"875 400 400 0.\n0. 0. 0.\n0.\n1.\n800 800\n", pose, pose, box}),
          Join({"1170 0 960 0\n0 1171 540 0\n0 0 1 0\n0 0 0 1\n", pose, pose, box}), Join({"9 4 3", pose, pose, box})};
}

}  // namespace nrff::fuzz

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace nrff;  // NOLINT(google-build-using-namespace)
  const auto& folder = fuzz::Folder();
  static const bool has_photos = [&] {
    for (const char* name : {"0_a.png", "2_b.png"}) WritePhoto(folder / "rgb" / name, {.width = 8, .height = 6});
    return std::filesystem::create_directory(folder / "pose");
  }();
  static_cast<void>(has_photos);
  const auto files = fuzz::Split(data, size, 4);
  fuzz::Write("intrinsics.txt", files[0]);
  fuzz::Write("pose/0_a.txt", files[1]);
  fuzz::Write("pose/2_b.txt", files[2]);
  fuzz::Write("bbox.txt", files[3]);
  const auto source = fuzz::ParseOrError(folder, [&] { return ReadNsvfSource(folder).value(); });
  if (source) fuzz::RequireUsable(*source);
  return 0;
}
