#include "sfm/source.h"

#include <Eigen/LU>
#include <string>
#include <system_error>
#include <utility>

#include "pipeline/files.h"

namespace nrff {
namespace {

constexpr double kMaxRotationError = 1e-3;

bool SameCamera(const ColmapCamera& a, const ColmapCamera& b) {
  return a.model == b.model && a.width == b.width && a.height == b.height && a.params == b.params;
}

uint32_t AddOrShareCamera(ColmapModel& model, ColmapCamera camera) {
  for (const auto& [id, known] : model.cameras) {
    if (SameCamera(known, camera)) return id;
  }
  camera.id = static_cast<uint32_t>(model.cameras.size() + 1);
  return model.cameras.emplace(camera.id, std::move(camera)).first->first;
}

}  // namespace

void CheckRigid(const Eigen::Matrix4d& matrix, const std::string& where) {
  if (!matrix.allFinite())
    throw InputError(where + ": the pose holds NaN or infinity; expected finite numbers, export the poses again");
  const Eigen::Matrix3d rotation = matrix.topLeftCorner<3, 3>();
  const double error =
      (rotation.transpose() * rotation - Eigen::Matrix3d::Identity()).cwiseAbs().maxCoeff<Eigen::PropagateNaN>();
  if (!(error <= kMaxRotationError)) {
    throw InputError(where + ": the pose's 3×3 part is not a rotation (RᵀR differs from the identity by " +
                     std::to_string(error) + ", allowed is 0.001); remove scale and shear from the poses");
  }
  if (rotation.determinant() < 0) {
    throw InputError(
        where + ": the pose's rotation is left-handed (determinant −1); expected a right-handed one, flip one axis");
  }
  if ((matrix.row(3) - Eigen::RowVector4d(0, 0, 0, 1)).cwiseAbs().maxCoeff() > kMaxRotationError) {
    throw InputError(where + ": the pose's last row is not 0 0 0 1; expected a rigid 4×4 matrix");
  }
}

void AddPosedImage(Source& source, const SourceImage& image, ColmapCamera camera,
                   const Eigen::Matrix4d& world_from_camera, const std::string& where) {
  CheckRigid(world_from_camera, where);
  ColmapModel& model = source.model ? *source.model : source.model.emplace();
  ColmapImage posed;
  posed.id = static_cast<uint32_t>(model.images.size() + 1);
  posed.camera_id = AddOrShareCamera(model, std::move(camera));
  posed.name = image.path.native();
  posed.rotation = Eigen::Quaterniond(world_from_camera.topLeftCorner<3, 3>()).conjugate().normalized();
  posed.translation = -(posed.rotation * world_from_camera.topRightCorner<3, 1>());
  if (!posed.translation.allFinite()) {
    throw InputError(where + ": the pose's position is too far away to compute with; expected finite coordinates");
  }
  model.images.emplace(posed.id, std::move(posed));
  source.images.push_back(image);
}

ColmapCamera ScaledCamera(const ColmapCamera& camera, int width, int height) {
  if (camera.width == width && camera.height == height) return camera;
  const double scale_x = static_cast<double>(width) / camera.width;
  const double scale_y = static_cast<double>(height) / camera.height;
  ColmapCamera scaled = camera;
  scaled.width = width;
  scaled.height = height;
  const std::string name = CameraModelName(camera.model);
  const bool one_focal = name.starts_with("SIMPLE") || name.starts_with("RADIAL");
  if (one_focal) {
    scaled.params[0] *= (scale_x + scale_y) / 2;
    scaled.params[1] *= scale_x;
    scaled.params[2] *= scale_y;
  } else {
    scaled.params[0] *= scale_x;
    scaled.params[1] *= scale_y;
    scaled.params[2] *= scale_x;
    scaled.params[3] *= scale_y;
  }
  return scaled;  // distortion is in units of the focal length
}

RejectedFile Rejection(const std::filesystem::path& root, const std::filesystem::path& path, const Error& error) {
  std::string reason = error.what();
  const std::string prefix = EscapePath(root / path) + ": ";
  if (reason.starts_with(prefix)) reason.erase(0, prefix.size());
  return {EscapePath(path), reason};
}

bool IsFile(const std::filesystem::path& path) {
  std::error_code ignored;
  return path.native().find('\0') == std::string::npos && std::filesystem::is_regular_file(path, ignored);
}

std::filesystem::path FindPhoto(const std::filesystem::path& root, const std::filesystem::path& stem) {
  for (const char* extension : {"", ".png", ".jpg", ".jpeg", ".JPG", ".PNG", ".tif", ".tiff", ".webp"}) {
    std::filesystem::path candidate = stem;
    candidate += extension;
    if (IsFile(root / candidate)) return candidate;
  }
  return {};
}

}  // namespace nrff
