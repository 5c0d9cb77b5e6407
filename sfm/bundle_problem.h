// The unknowns of a bundle refinement, the observations that tie them, and their minimisation. Inside sfm/;
// `bundle_refinement.h` is what others use.
#pragma once

#include <ceres/ceres.h>

#include <Eigen/Geometry>
#include <array>
#include <memory>
#include <string>
#include <vector>

#include "sfm/bundle_refinement.h"
#include "sfm/colmap_model.h"

namespace nrff {

// Every component is in its anchor's camera frame with the baseline to the partner as the unit, so that no digit
// depends on the world's origin, axes or scale.
struct Bundle {
  // Intrinsics that are free or held together, from the most to the least important.
  enum Group { kFocal, kPrincipal, kDistortion, kGroups };

  struct Camera {
    uint32_t id = 0;
    CameraModel model = CameraModel::kPinhole;
    int width = 0, height = 0;        // px
    size_t n_params = 0, offset = 0;  // of its intrinsics in `values`
    std::array<bool, kGroups> free{true, true, true};
  };
  struct Image {
    uint32_t id = 0;
    size_t camera = 0, component = 0;
  };
  struct Point {
    uint64_t id = 0;
    size_t component = 0;
  };
  struct Observation {
    size_t image = 0, point = 0;
    Eigen::Vector2d px;
  };
  struct Component {
    size_t anchor = 0, partner = 0;
    int fixed_axis = 0;  // the partner's largest coordinate: with it the scale is fixed
    // world = origin + unit · rotation · frame
    Eigen::Quaterniond rotation = Eigen::Quaterniond::Identity();
    Eigen::Vector3d origin = Eigen::Vector3d::Zero();
    double unit = 1;
  };

  std::vector<Camera> cameras;
  std::vector<Image> images;
  std::vector<Point> points;
  std::vector<Observation> observations;  // by point
  std::vector<Component> components;
  // Points (3 each), images (rotation camera_from_frame xyzw, centre), cameras. In one piece, since Ceres orders its
  // parameter blocks by address and the order decides the last bits.
  std::vector<double> values;

  size_t ImageOffset(size_t image) const { return 3 * points.size() + 7 * image; }
  Eigen::Map<Eigen::Vector3d> Position(size_t point) { return Eigen::Map<Eigen::Vector3d>(&values[3 * point]); }
  Eigen::Map<const Eigen::Vector3d> Position(size_t point) const {
    return Eigen::Map<const Eigen::Vector3d>(&values[3 * point]);
  }
  Eigen::Map<Eigen::Quaterniond> Rotation(size_t image) {
    return Eigen::Map<Eigen::Quaterniond>(&values[ImageOffset(image)]);
  }
  Eigen::Map<const Eigen::Quaterniond> Rotation(size_t image) const {
    return Eigen::Map<const Eigen::Quaterniond>(&values[ImageOffset(image)]);
  }
  Eigen::Map<Eigen::Vector3d> Center(size_t image) {
    return Eigen::Map<Eigen::Vector3d>(&values[ImageOffset(image) + 4]);
  }
  Eigen::Map<const Eigen::Vector3d> Center(size_t image) const {
    return Eigen::Map<const Eigen::Vector3d>(&values[ImageOffset(image) + 4]);
  }
  double* Intrinsics(size_t camera) { return &values[cameras[camera].offset]; }
  const double* Intrinsics(size_t camera) const { return &values[cameras[camera].offset]; }
  ColmapCamera CameraAt(size_t camera) const;  // with its present parameters
  bool IsAnchor(size_t image) const { return components[images[image].component].anchor == image; }
  // Axes of an image's centre, and parameters of a camera, that the gauge or the data hold.
  std::vector<int> HeldAxes(size_t image) const;
  std::vector<int> HeldParams(size_t camera) const;
};

// [first, last) of a group's parameters.
std::array<int, 2> GroupRange(CameraModel model, Bundle::Group group);

// Cauchy's, ρ(s) = c² log(1 + s/c²), without the rounding of 1 + s that Ceres's own has: there, residuals below 1e-8 c
// are none.
class CauchyLoss final : public ceres::LossFunction {
 public:
  explicit CauchyLoss(double scale) : square_(scale * scale) {}
  void Evaluate(double s, double rho[3]) const override;

 private:
  double square_;
};

// (projection − observation) in px over (rotation, centre, point, intrinsics). Where the point is not in front of the
// camera the residual is kUnseen_px without a derivative: an outlier like others, however the point got there, and
// finite when it passes through the centre.
inline constexpr double kUnseen_px = 1e6;
std::unique_ptr<ceres::CostFunction> ReprojectionCost(CameraModel model, const Eigen::Vector2d& px);
Eigen::Vector2d Residual(const Bundle& bundle, const Bundle::Observation& observation);  // px

// What of a model can be refined, with what was left out noted in `certificate`. Throws as RefineBundle does. Where
// nothing remains, or a component has no frame, `certificate.degeneracy` says why.
Bundle SelectBundle(const ColmapModel& model, BundleCertificate& certificate);

// ½ Σ ρ, px².
double RobustCost(const Bundle& bundle, double loss_scale_px);

ceres::Solver::Summary Solve(Bundle& bundle, double loss_scale_px, const BundleOptions& options);

// `model` with the bundle's poses, points and cameras in their place, every baseline of its old length.
ColmapModel WithBundle(const ColmapModel& model, const Bundle& bundle);

}  // namespace nrff
