#include "sfm/nsvf.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <set>
#include <string>
#include <string_view>
#include <system_error>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/photo_name.h"
#include "sfm/image_io.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr double kBoxMargin = 1.2;

// All numbers of a text file, whatever separates them.
std::vector<double> ReadNumbers(const fs::path& file) {
  constexpr char kSpaces[] = " \t\r\n,";
  const std::string text = ReadFile(file);
  std::vector<double> numbers;
  for (size_t at = text.find_first_not_of(kSpaces); at != std::string::npos; at = text.find_first_not_of(kSpaces, at)) {
    const std::string_view word = std::string_view(text).substr(at, text.find_first_of(kSpaces, at) - at);
    double value = 0;
    const auto [end, error] = std::from_chars(word.data(), word.data() + word.size(), value);
    if (error != std::errc() || end != word.data() + word.size()) {
      throw InputError(EscapePath(file) + ": found \"" + EscapePath(std::string(word)) +
                       "\" where a number is expected");
    }
    numbers.push_back(value);
    at += word.size();
  }
  return numbers;
}

// Width and height stay 0 where the file does not give them.
ColmapCamera ReadIntrinsics(const fs::path& file) {
  const std::vector<double> n = ReadNumbers(file);
  if (!std::all_of(n.begin(), n.end(), [](double number) { return std::isfinite(number); })) {
    throw InputError(EscapePath(file) + ": holds NaN or infinity; expected finite numbers");
  }
  ColmapCamera camera;
  switch (n.size()) {
    case 16:
      camera.params = {n[0], n[5], n[2], n[6]};
      break;
    case 9:
      camera.params = {n[0], n[4], n[2], n[5]};
      break;
    case 11:
      camera.height = static_cast<int>(std::clamp(n[9], 0.0, 1e6));
      camera.width = static_cast<int>(std::clamp(n[10], 0.0, 1e6));
      [[fallthrough]];
    case 3:
    case 4:
      camera.params = {n[0], n[0], n[1], n[2]};
      break;
    default:
      throw InputError(EscapePath(file) + ": holds " + std::to_string(n.size()) +
                       " numbers; expected a 4×4 matrix or \"f cx cy …\"");
  }
  if (camera.params[0] <= 0 || camera.params[1] <= 0)
    throw InputError(EscapePath(file) + ": the focal length is not positive");
  return camera;
}

Eigen::Matrix4d ReadPose(const fs::path& file) {
  const std::vector<double> n = ReadNumbers(file);
  if (n.size() != 16) {
    throw InputError(EscapePath(file) + ": holds " + std::to_string(n.size()) +
                     " numbers; expected a 4×4 matrix of 16");
  }
  return Eigen::Map<const Eigen::Matrix<double, 4, 4, Eigen::RowMajor>>(n.data());
}

std::array<double, 6> ReadBox(const fs::path& file) {
  const std::vector<double> n = ReadNumbers(file);
  if (n.size() < 6)
    throw InputError(EscapePath(file) + ": holds " + std::to_string(n.size()) + " numbers; expected min xyz, max xyz");
  std::array<double, 6> box{};
  for (int axis = 0; axis < 3; ++axis) {
    const double center = (n[axis] + n[axis + 3]) / 2, half = (n[axis + 3] - n[axis]) / 2 * kBoxMargin;
    box[axis] = center - half;
    box[axis + 3] = center + half;
    if (!(box[axis] < box[axis + 3]) || !std::isfinite(box[axis] - box[axis + 3])) {
      throw InputError(EscapePath(file) + ": the box is empty or not finite; expected min xyz, max xyz");
    }
  }
  return box;
}

// The split of each name by its prefix; nothing where some name has none.
class Prefixes {
 public:
  explicit Prefixes(const std::vector<fs::path>& poses) {
    for (const fs::path& pose : poses) {
      const std::string name = pose.filename();
      given_ &= name.size() > 2 && name[0] >= '0' && name[0] <= '2' && name[1] == '_';
      has_test_ |= name[0] == '2';
    }
  }
  bool IsUnused(const std::string& name) const { return given_ && has_test_ && name[0] == '1'; }
  std::optional<Split> Of(const std::string& name) const {
    if (!given_) return {};
    return name[0] == '0' ? Split::kTrain : Split::kTest;
  }

 private:
  bool given_ = true;
  bool has_test_ = false;
};

}  // namespace

std::optional<Source> ReadNsvfSource(const fs::path& root) {
  if (!IsFile(root / "intrinsics.txt") || !fs::is_directory(root / "pose")) return {};
  const fs::path photo_dir = fs::is_directory(root / "rgb") ? "rgb" : "images";
  if (!fs::is_directory(root / photo_dir)) {
    throw InputError(EscapePath(root) + ": has intrinsics.txt and pose/ but no rgb/ with the photos; put them there");
  }
  std::vector<fs::path> poses = ListFiles(root / "pose");
  std::erase_if(poses, [](const fs::path& path) { return path.extension() != ".txt"; });
  if (poses.empty())
    throw InputError(EscapePath(root / "pose") + ": holds no .txt files; expected one 4×4 pose for each photo");

  Source source;
  source.kind = "nsvf";
  source.root = root;
  source.evidence = "intrinsics.txt and pose/ with " + std::to_string(poses.size()) + " poses";
  source.background = Background::kWhite;
  if (IsFile(root / "bbox.txt")) source.box = ReadBox(root / "bbox.txt");
  const ColmapCamera intrinsics = ReadIntrinsics(root / "intrinsics.txt");
  const Prefixes prefixes(poses);
  std::set<std::string> posed_stems;
  for (const fs::path& pose : poses) {
    const std::string stem = pose.stem();
    posed_stems.insert(stem);
    if (prefixes.IsUnused(stem)) continue;
    const fs::path photo = FindPhoto(root, photo_dir / stem);
    if (photo.empty()) {
      source.rejected.push_back({EscapePath(photo_dir / stem), "has a pose but does not exist"});
      continue;
    }
    ColmapCamera camera = intrinsics;
    if (camera.width <= 0 || camera.height <= 0) {
      try {
        const ImageInfo info = ProbeImage(root / photo);
        camera.width = info.width;
        camera.height = info.height;
      } catch (const Error& error) {
        source.rejected.push_back(Rejection(root, photo, error));
        continue;
      }
    }
    const fs::path pose_file = root / "pose" / pose.filename();
    AddPosedImage(source, {photo, prefixes.Of(stem)}, std::move(camera), ReadPose(pose_file), EscapePath(pose_file));
  }
  for (const fs::path& photo : ListFiles(root / photo_dir)) {
    if (HasPhotoExtension(photo) && !posed_stems.contains(photo.stem())) {
      source.rejected.push_back({EscapePath(photo_dir / photo.filename()), "has no pose"});
    }
  }
  if (source.images.empty()) {
    throw InputError(EscapePath(root) + ": none of the " + std::to_string(poses.size()) +
                     " poses has a photo that can be read in " + photo_dir.native() +
                     "/ (the first: " + source.rejected.front().name + " " + source.rejected.front().reason + ")");
  }
  return source;
}

}  // namespace nrff
