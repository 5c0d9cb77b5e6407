#include "sfm/trajectory.h"

#include <Eigen/LU>
#include <Eigen/SVD>
#include <algorithm>
#include <cmath>
#include <iomanip>
#include <limits>
#include <sstream>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/manifest.h"
#include "sfm/colmap_model.h"
#include "sfm/recognise.h"
#include "sfm/source.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr double kRotationTolerance = 1e-3;
constexpr double kPerturbedTolerance = 0.1;  // of the singular values of what is no rotation but was one
constexpr double kMostPoses = 1e6;           // numbers of six digits

// Rows of numbers, as a stream of tokens that knows its line.
class Numbers {
 public:
  explicit Numbers(const fs::path& file) : where_(EscapePath(file)), text_(ReadFile(file)) {}

  bool AtEnd() {
    while (text_.peek() != EOF && std::isspace(text_.peek()) != 0) line_ += text_.get() == '\n' ? 1 : 0;
    return text_.peek() == EOF;
  }
  double Next() {
    std::string word;
    if (AtEnd() || !(text_ >> word)) Throw("the file ends where a number is expected");
    try {
      size_t n_read = 0;
      const double value = std::stod(word, &n_read);
      if (n_read == word.size() && std::isfinite(value)) return value;
    } catch (const std::logic_error&) {
    }
    Throw("found \"" + EscapePath(word) + "\" where a finite number is expected");
  }
  Eigen::Matrix4d Matrix() {
    Eigen::Matrix4d matrix;
    for (int row = 0; row < 4; ++row) {
      for (int column = 0; column < 4; ++column) matrix(row, column) = Next();
    }
    return matrix;
  }
  [[noreturn]] void Throw(const std::string& problem) const {
    throw InputError(where_ + ", line " + std::to_string(line_) + ": " + problem);
  }

 private:
  std::string where_;
  std::istringstream text_;
  int line_ = 1;
};

bool IsScaledRotation(const Eigen::Matrix3d& matrix, double scale) {
  return scale > 0 &&
         (matrix * matrix.transpose() / (scale * scale) - Eigen::Matrix3d::Identity()).norm() < kRotationTolerance;
}

Trajectory ReadLog(const fs::path& file) {
  Numbers numbers(file);
  Trajectory trajectory;
  while (!numbers.AtEnd()) {
    const double index = numbers.Next();
    numbers.Next();
    numbers.Next();
    if (!(index >= 0 && index < kMostPoses) || index != std::floor(index)) {
      numbers.Throw("expected the whole number of an image");
    }
    const Eigen::Matrix4d world_from_camera = numbers.Matrix();
    const Eigen::Matrix3d rotation = world_from_camera.topLeftCorner<3, 3>();
    if (!IsScaledRotation(rotation, 1) || rotation.determinant() < 0) numbers.Throw("the pose holds no rotation");
    std::ostringstream name;
    name << '#' << std::setw(6) << std::setfill('0') << int64_t(index);
    trajectory.push_back(
        {name.str(), Eigen::Quaterniond(rotation).normalized(), world_from_camera.topRightCorner<3, 1>()});
  }
  if (trajectory.empty()) throw InputError(EscapePath(file) + ": holds no poses");
  return trajectory;
}

// `named_by_id`: the images are called by their ids, as inside artifacts.
Trajectory FromModel(const ColmapModel& model, const fs::path& where, bool named_by_id = false) {
  Trajectory trajectory;
  for (const auto& [id, image] : model.images) {
    const std::string name = fs::path(image.name).replace_extension().string();
    trajectory.push_back({named_by_id ? "#" + name : name, image.rotation.conjugate(), image.Center()});
  }
  if (trajectory.empty()) throw InputError(EscapePath(where) + ": holds no posed image");
  return trajectory;
}

// Nothing where `dir` is no such folder.
Trajectory ReadPoseFolder(const fs::path& dir) {
  const std::vector<fs::path> files = ListFiles(dir);
  const bool only_poses = std::all_of(files.begin(), files.end(), [&](const fs::path& file) {
    return file.extension() == ".txt" && file.parent_path() == dir;
  });
  if (!only_poses) return {};
  Trajectory trajectory;
  for (const fs::path& file : files) {
    Numbers numbers(file);
    const Eigen::Matrix4d world_from_camera = numbers.Matrix();
    const Eigen::JacobiSVD<Eigen::Matrix3d> svd(world_from_camera.topLeftCorner<3, 3>(),
                                                Eigen::ComputeFullU | Eigen::ComputeFullV);
    const Eigen::Matrix3d rotation = svd.matrixU() * svd.matrixV().transpose();
    if (!numbers.AtEnd()) numbers.Throw("found more than the 16 numbers of a 4×4 matrix");
    if ((svd.singularValues() - Eigen::Vector3d::Ones()).cwiseAbs().maxCoeff() > kPerturbedTolerance ||
        rotation.determinant() < 0) {
      numbers.Throw("the pose's 3×3 part is no rotation");
    }
    trajectory.push_back(
        {file.stem().string(), Eigen::Quaterniond(rotation).normalized(), world_from_camera.topRightCorner<3, 1>()});
  }
  return trajectory;
}

bool HoldsModel(const fs::path& dir) { return IsFile(dir / "images.bin") || IsFile(dir / "images.txt"); }

// cameras.json of a train artifact: the cameras as training has corrected them, called by their photos' names.
Trajectory ReadCorrectedCameras(const fs::path& file) {
  const std::string where = EscapePath(file);
  const Json json = ReadJson(file);
  Trajectory trajectory;
  for (const Json& view : Get<Json>(json, "views", where)) {
    if (Get<std::string>(view, "split", where) != "train") continue;
    const auto pose = Get<std::array<double, 16>>(view, "scene_from_camera", where);
    const Eigen::Matrix4d matrix = Eigen::Map<const Eigen::Matrix<double, 4, 4, Eigen::RowMajor>>(pose.data());
    const Eigen::Matrix3d rotation = matrix.topLeftCorner<3, 3>();
    if (!matrix.allFinite() || !IsScaledRotation(rotation, 1) || rotation.determinant() < 0) {
      throw CorruptError(where + ": the pose of view " + Get<std::string>(view, "id", where) +
                         " holds no rotation; train again");
    }
    trajectory.push_back({fs::path(Get<std::string>(view, "name", where)).replace_extension().string(),
                          Eigen::Quaterniond(rotation).normalized(), matrix.topRightCorner<3, 1>()});
  }
  return trajectory;
}

Trajectory ReadFolder(const fs::path& path) {
  if (IsFile(path / "cameras.json")) return ReadCorrectedCameras(path / "cameras.json");
  for (const fs::path& place : {path / "pose" / "sparse", path / "sparse", path}) {
    const bool is_artifact = IsFile(path / kManifestName);
    const bool made_here = place == path || IsFile(path / kWorkspaceMarker) || is_artifact;
    if (!made_here || !HoldsModel(place)) continue;
    const std::optional<Manifest> manifest = is_artifact ? ReadManifest(path) : std::nullopt;
    return FromModel(ReadColmapModel(place), place, manifest && manifest->kind != "pose");
  }
  if (Trajectory poses = ReadPoseFolder(path); !poses.empty()) return poses;
  const Source source = RecogniseCapture(path);
  if (!source.model) {
    throw InputError(EscapePath(path) + ": has no poses (" + source.evidence +
                     "); give a posed capture, a workspace, a COLMAP model or a .log file");
  }
  return FromModel(*source.model, path);
}

}  // namespace

Trajectory ReadTrajectory(const fs::path& given) {
  if (!fs::exists(given)) throw InputError(EscapePath(given) + ": does not exist");
  fs::path path = given.lexically_normal();
  if (!path.has_filename()) path = path.parent_path();  // a slash at the end
  Trajectory trajectory = fs::is_directory(path) ? ReadFolder(path) : ReadLog(path);
  std::sort(trajectory.begin(), trajectory.end(),
            [](const TrajectoryPose& a, const TrajectoryPose& b) { return a.name < b.name; });
  for (size_t i = 1; i < trajectory.size(); ++i) {
    if (trajectory[i].name == trajectory[i - 1].name) {
      throw InputError(EscapePath(path) + ": two poses are called " + EscapePath(trajectory[i].name));
    }
  }
  return trajectory;
}

void WriteTrajectoryLog(const Trajectory& trajectory, const fs::path& file) {
  std::ostringstream text;
  text << std::setprecision(std::numeric_limits<double>::max_digits10);
  for (size_t i = 0; i < trajectory.size(); ++i) {
    const Eigen::Matrix3d rotation = trajectory[i].rotation.toRotationMatrix();
    text << i << ' ' << i << " 0\n";
    for (int row = 0; row < 3; ++row) {
      for (int column = 0; column < 3; ++column) text << rotation(row, column) << ' ';
      text << trajectory[i].center(row) << '\n';
    }
    text << "0 0 0 1\n";
  }
  WriteFileAtomically(file, text.str());
}

Eigen::Matrix4d ReadSimilarity(const fs::path& file) {
  Numbers numbers(file);
  Eigen::Matrix4d matrix = numbers.Matrix();
  if (!numbers.AtEnd()) numbers.Throw("found more than the 16 numbers of a 4×4 matrix");
  const Eigen::Matrix3d linear = matrix.topLeftCorner<3, 3>();
  if (!IsScaledRotation(linear, std::cbrt(linear.determinant())) ||
      (matrix.row(3) - Eigen::RowVector4d(0, 0, 0, 1)).norm() > 0) {
    throw InputError(EscapePath(file) + ": is no similarity (a rotation times a scale, and a translation)");
  }
  return matrix;
}

Trajectory Transformed(const Trajectory& trajectory, const Eigen::Matrix4d& similarity) {
  const Eigen::Matrix3d linear = similarity.topLeftCorner<3, 3>();
  const Eigen::Quaterniond rotation(linear / std::cbrt(linear.determinant()));
  Trajectory moved = trajectory;
  for (TrajectoryPose& pose : moved) {
    pose.rotation = (rotation * pose.rotation).normalized();
    pose.center = linear * pose.center + similarity.topRightCorner<3, 1>();
  }
  return moved;
}

}  // namespace nrff
