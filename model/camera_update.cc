#include "model/camera_update.h"

#include <ATen/ATen.h>

#include <Eigen/Cholesky>
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <utility>

#include "pipeline/statistics.h"

namespace nrff {
namespace {

using torch::Tensor;
using Vector6 = Eigen::Matrix<double, 6, 1>;
using Matrix6 = Eigen::Matrix<double, 6, 6>;
using Vector7 = Eigen::Matrix<double, 7, 1>;
using Matrix7 = Eigen::Matrix<double, 7, 7>;
using Matrix67 = Eigen::Matrix<double, 6, 7>;

// Standard deviations that corrections have before anything is seen. A pixel's are those of a pose of a careful
// reconstruction in the worst case; photos outweigh them by far in all that they tell.
constexpr double kPoseDeviation_px = 1.5;
constexpr double kLogFocalDeviation = 0.005, kPrincipalDeviation_px = 2;
constexpr double kMostStep_px = 2;     // a picture's motion in one step: derivatives hold for about a pixel
constexpr double kHuber = 1.345;       // of the residuals' deviation: 95 % efficient where they are normal
constexpr double kDeviation = 1.4826;  // of the median of absolute normal values
// So many residuals say as much as one: a pixel's three, and those of a model that errs in patches.
constexpr double kAlike = 10;
constexpr double kSteep = 0.1;    // change of a colour within a pixel from which derivatives are trusted less and less
constexpr double kEdge = 0.1;     // of the distance, within a pixel
constexpr double kHalf_px = 0.5;  // of the differences
constexpr int kKinds = 5;         // the pixel, then to its left, right, above, below

Vec3 Array(const Eigen::Vector3d& v) { return {v.x(), v.y(), v.z()}; }

Eigen::Matrix3d Rotation(const View& view) {
  return Eigen::Map<const Eigen::Matrix<double, 4, 4, Eigen::RowMajor>>(view.scene_from_camera.data())
      .topLeftCorner<3, 3>();
}
Eigen::Vector3d Centre(const View& view) {
  const Mat4& m = view.scene_from_camera;
  return {m[3], m[7], m[11]};
}

// One pixel of a view and what the model shows there.
struct Sighting {
  Eigen::Vector3d residual;                  // photo − model
  Eigen::Matrix<double, 3, 2> by_place;      // derivative of the model's colour by the pixel's place
  Eigen::Matrix<double, 2, 6> motion;        // of the place in the picture by turn and shift
  Eigen::Matrix<double, 2, 3> motion_inner;  // by log_focal, shift_x, shift_y
  double depth = 0;                          // along the axis, scene units
};

// In derivatives of this squared size, of three colours.
double Trust(double squared) { return std::pow(1 + squared / (3 * kSteep * kSteep), -2); }

// How much a pixel tells about the camera: much where the photo changes about it, but not where it leaps.
double Telling(const PixelSource& pixels, const int32_t* pixel) {
  const View& view = pixels.views()[size_t(pixel[0])];
  const uint8_t* photo = pixels.pack().Pixels(view);
  const auto at = [&](int x, int y) {
    x = std::clamp(x, 0, view.width - 1);
    y = std::clamp(y, 0, view.height - 1);
    return photo + (size_t(y) * size_t(view.width) + size_t(x)) * size_t(view.channels);
  };
  const int x = pixel[1], y = pixel[2];
  double sum = 0;  // squared change of colours within a pixel
  for (int c = 0; c < 3; ++c) {
    sum += std::pow((double(at(x + 1, y)[c]) - at(x - 1, y)[c]) / (2 * 255), 2);
    sum += std::pow((double(at(x, y + 1)[c]) - at(x, y - 1)[c]) / (2 * 255), 2);
  }
  return sum * Trust(sum);
}

// Of every kTournament pixels the one that says most about where the camera is.
Tensor MostTelling(const PixelSource& pixels, const Tensor& drawn) {
  const auto* pixel = drawn.const_data_ptr<int32_t>();
  std::vector<int32_t> chosen;
  for (int64_t first = 0; first < drawn.size(0); first += kTournament) {
    const int32_t* best = pixel + 3 * first;
    for (int64_t i = first + 1; i < first + kTournament; ++i) {
      if (Telling(pixels, pixel + 3 * i) > Telling(pixels, best)) best = pixel + 3 * i;
    }
    chosen.insert(chosen.end(), best, best + 3);
  }
  return at::tensor(chosen, torch::kInt).view({-1, 3});
}

std::vector<std::vector<Sighting>> Look(const PixelSource& pixels, const RenderTrainingRays& render,
                                        const CameraLook& look) {
  const std::vector<View>& views = pixels.views();
  const Tensor drawn = MostTelling(pixels, pixels.DrawOfEachView(kTournament * look.n_pixels, look.seed, look.counter));
  const int64_t n = drawn.size(0);
  const auto* pixel = drawn.const_data_ptr<int32_t>();
  // A view whose principal point lies half a pixel to the right shows, at a pixel's centre, what lies to its left.
  std::vector<View> shifted;
  constexpr double kOffsets[kKinds][2] = {{0, 0}, {-kHalf_px, 0}, {kHalf_px, 0}, {0, -kHalf_px}, {0, kHalf_px}};
  for (const View& view : views) {
    for (const auto& [x, y] : kOffsets) {
      shifted.push_back(view);
      shifted.back().cx -= x;
      shifted.back().cy -= y;
    }
  }
  Tensor places = at::empty({kKinds * n, 3}, torch::kInt), view_of = at::empty({kKinds * n}, torch::kInt);
  auto* place = places.mutable_data_ptr<int32_t>();
  auto* view_of_ray = view_of.mutable_data_ptr<int32_t>();
  for (int64_t i = 0; i < n; ++i) {
    for (int kind = 0; kind < kKinds; ++kind, place += 3) {
      place[0] = kKinds * pixel[3 * i] + kind;
      place[1] = pixel[3 * i + 1];
      place[2] = pixel[3 * i + 2];
      *view_of_ray++ = pixel[3 * i];
    }
  }
  const Tensor target = pixels.At(drawn).target.contiguous();
  const RenderedImage shown = render(RaysThroughPixels(shifted, places, torch::kFloat), view_of);
  std::vector<std::vector<Sighting>> sightings(views.size());
  for (int64_t i = 0; i < n; ++i) {
    const View& view = views[size_t(pixel[3 * i])];
    const auto colour = [&](int kind) {
      return Eigen::Map<const Eigen::Vector3f>(shown.rgb.data() + 3 * (kKinds * i + kind)).cast<double>();
    };
    const float* depth = shown.depth.data() + kKinds * i;
    if (!(depth[0] > 0)) continue;  // nothing opaque
    // Before other surfaces, what is seen moves with neither; before the background (depth 0) with the object.
    const bool hides = std::any_of(depth + 1, depth + kKinds, [&](float other) {
      return other > 0 && std::abs(other - depth[0]) > kEdge * depth[0];
    });
    if (hides) continue;
    const double u = pixel[3 * i + 1] + 0.5 - view.cx, v = pixel[3 * i + 2] + 0.5 - view.cy;
    const Eigen::Vector3d through(u / view.fx, v / view.fy, 1);
    const double z = double(depth[0]) / through.norm();
    const Eigen::Vector3d point = z * through;
    Sighting sighting;
    sighting.depth = z;
    sighting.residual =
        Eigen::Map<const Eigen::Vector3f>(target.const_data_ptr<float>() + 3 * i).cast<double>() - colour(0);
    sighting.by_place.col(0) = (colour(2) - colour(1)) / (2 * kHalf_px);
    sighting.by_place.col(1) = (colour(4) - colour(3)) / (2 * kHalf_px);
    if (!std::isfinite(z) || !sighting.residual.allFinite() || !sighting.by_place.allFinite()) continue;
    // The pixel of the moved camera shows the point turn × X + shift away, in the axes of the camera as it was.
    Eigen::Matrix<double, 2, 3> projection;
    projection << view.fx / z, 0, -u / z, 0, view.fy / z, -v / z;
    Eigen::Matrix<double, 3, 6> moved;
    moved << 0, point.z(), -point.y(), 1, 0, 0, -point.z(), 0, point.x(), 0, 1, 0, point.y(), -point.x(), 0, 0, 0, 1;
    sighting.motion = projection * moved;
    sighting.motion_inner << -u, -1, 0, -v, 0, -1;
    sightings[size_t(pixel[3 * i])].push_back(sighting);
  }
  return sightings;
}

double ResidualDeviation(const std::vector<std::vector<Sighting>>& sightings) {
  std::vector<double> sizes;
  for (const auto& of_view : sightings) {
    for (const Sighting& sighting : of_view) {
      for (int c = 0; c < 3; ++c) sizes.push_back(std::abs(sighting.residual[c]));
    }
  }
  constexpr double kQuantisation = 1. / 255;
  return std::max(kQuantisation, kDeviation * Median(std::move(sizes)));  // the former where there are none
}

// NaN where there are none.
double MedianDepth(const std::vector<Sighting>& of_view) {
  std::vector<double> depths;
  depths.reserve(of_view.size());
  for (const Sighting& sighting : of_view) depths.push_back(sighting.depth);
  return Median(std::move(depths));
}

Vector6 Packed(const PoseCorrection& pose) {
  Vector6 packed;
  packed << Eigen::Vector3d(pose.turn.data()), Eigen::Vector3d(pose.shift.data());
  return packed;
}
Eigen::Vector3d Packed(const IntrinsicsCorrection& inner) { return {inner.log_focal, inner.shift_x, inner.shift_y}; }

// Of the picture, px.
double Displacement(const std::vector<Sighting>& of_view, const Vector6& pose, const Eigen::Vector3d& inner) {
  double sum = 0;
  for (const Sighting& sighting : of_view)
    sum += (sighting.motion * pose + sighting.motion_inner * inner).squaredNorm();
  return of_view.empty() ? 0 : std::sqrt(sum / double(of_view.size()));
}

// Derivatives of a camera's turn and shift, in its own axes, by a similarity of the world: rotation vector,
// translation, log of scale.
Matrix67 BySimilarity(const View& view) {
  const Eigen::Matrix3d inverse = Rotation(view).transpose();
  const Eigen::Vector3d centre = Centre(view);
  Eigen::Matrix3d cross;
  cross << 0, -centre.z(), centre.y(), centre.z(), 0, -centre.x(), -centre.y(), centre.x(), 0;
  Matrix67 by = Matrix67::Zero();
  by.topLeftCorner<3, 3>() = inverse;
  by.bottomLeftCorner<3, 3>() = -inverse * cross;
  by.block<3, 3>(3, 3) = inverse;
  by.bottomRightCorner<3, 1>() = inverse * centre;
  return by;
}

// A radian counts as much as the shift that looks like it at `distance`.
Vector6 PoseWeights(double distance) {
  Vector6 weights = Vector6::Ones();
  weights.head<3>().setConstant(distance * distance);
  return weights;
}

// One camera, or all at one place, leave some of the seven open: these stay 0.
Vector7 Solve(Matrix7 normal, const Vector7& right) {
  normal.diagonal().array() += 1e-9 * std::max(normal.trace(), 1e-300);
  return normal.ldlt().solve(right);
}

// The median depth of all sightings, 1 where there are none.
double SceneDistance(const std::vector<std::vector<Sighting>>& sightings) {
  std::vector<double> depths;
  for (const auto& of_view : sightings) {
    for (const Sighting& sighting : of_view) depths.push_back(sighting.depth);
  }
  return depths.empty() ? 1 : Median(std::move(depths));
}

// ½ xᵀHx − bᵀx, H an arrow: a block for each pose, one for each kind of intrinsics, and those between.
struct System {
  struct OfView {
    Matrix6 normal = Matrix6::Zero();
    Vector6 right = Vector6::Zero();
    Eigen::Matrix<double, 6, 3> between = Eigen::Matrix<double, 6, 3>::Zero();
    Matrix67 constraint;  // what the pose adds to the common motion, transposed
    size_t kind = 0;
  };
  std::vector<OfView> views;
  std::vector<Eigen::Matrix3d> inner_normal;
  std::vector<Eigen::Vector3d> inner_right;
};

System Linearise(const std::vector<std::vector<Sighting>>& sightings, const std::vector<View>& given,
                 const CameraCorrections& so_far, double distance) {
  const double deviation = ResidualDeviation(sightings);
  System system;
  const Eigen::Vector3d inner_prior =
      Eigen::Vector3d(kLogFocalDeviation, kPrincipalDeviation_px, kPrincipalDeviation_px).cwiseAbs2().cwiseInverse();
  for (const IntrinsicsCorrection& inner : so_far.intrinsics) {
    system.inner_normal.emplace_back(inner_prior.asDiagonal());
    system.inner_right.emplace_back(-inner_prior.cwiseProduct(Packed(inner)));
  }
  for (size_t i = 0; i < given.size(); ++i) {
    System::OfView of;
    of.kind = so_far.KindOf(given[i]);
    of.constraint = PoseWeights(distance).asDiagonal() * BySimilarity(given[i]);
    const double depth = MedianDepth(sightings[i]);
    const double turn = kPoseDeviation_px / given[i].fx, shift = turn * (depth > 0 ? depth : distance);
    Vector6 prior;
    prior << Eigen::Vector3d::Constant(1 / (turn * turn)), Eigen::Vector3d::Constant(1 / (shift * shift));
    of.normal.diagonal() += prior;
    of.right -= prior.cwiseProduct(Packed(so_far.poses[i]));
    for (const Sighting& sighting : sightings[i]) {
      const double size = sighting.residual.norm() / std::sqrt(3.);
      const double weight = std::min(1., kHuber * deviation / std::max(size, 1e-12)) *
                            Trust(sighting.by_place.squaredNorm()) / (kAlike * deviation * deviation);
      const Eigen::Matrix<double, 3, 6> by_pose = sighting.by_place * sighting.motion;
      const Eigen::Matrix3d by_inner = sighting.by_place * sighting.motion_inner;
      of.normal += weight * by_pose.transpose() * by_pose;
      of.right += weight * by_pose.transpose() * sighting.residual;
      of.between += weight * by_pose.transpose() * by_inner;
      system.inner_normal[of.kind] += weight * by_inner.transpose() * by_inner;
      system.inner_right[of.kind] += weight * by_inner.transpose() * sighting.residual;
    }
    system.views.push_back(of);
  }
  return system;
}

struct Step {
  std::vector<Vector6> poses;
  std::vector<Eigen::Vector3d> inner;
};

double Limit(double displacement_px) { return std::min(1., kMostStep_px / std::max(displacement_px, 1e-12)); }

// The minimum where x and what was corrected before have no motion in common, C(x + x₀) = 0: it is H⁻¹(b − Cᵀλ) with
// CH⁻¹Cᵀ λ = C(H⁻¹b + x₀). Of H the poses are eliminated first. Steps are then held back to kMostStep_px.
Step MinimiseWithoutCommonMotion(const System& system, const std::vector<std::vector<Sighting>>& sightings,
                                 const CameraCorrections& so_far) {
  using Columns = Eigen::Matrix<double, Eigen::Dynamic, 8>;  // b, then Cᵀ
  const size_t n_views = system.views.size(), n_kinds = system.inner_normal.size();
  std::vector<Eigen::LDLT<Matrix6>> solvers;
  std::vector<Columns> pose_columns, inner_columns;
  std::vector<Eigen::Matrix3d> inner_normal = system.inner_normal;
  for (const Eigen::Vector3d& right : system.inner_right) {
    inner_columns.emplace_back(Columns::Zero(3, 8));
    inner_columns.back().col(0) = right;
  }
  for (const System::OfView& of : system.views) {
    solvers.emplace_back(of.normal);
    pose_columns.emplace_back(6, 8);
    pose_columns.back() << of.right, of.constraint;
    inner_normal[of.kind] -= of.between.transpose() * solvers.back().solve(of.between);
    inner_columns[of.kind] -= of.between.transpose() * solvers.back().solve(pose_columns.back());
  }
  for (size_t kind = 0; kind < n_kinds; ++kind)
    inner_columns[kind] = inner_normal[kind].ldlt().solve(inner_columns[kind]).eval();
  Matrix7 constrained = Matrix7::Zero();
  Vector7 in_common = Vector7::Zero();
  for (size_t i = 0; i < n_views; ++i) {
    const System::OfView& of = system.views[i];
    const Columns solved = solvers[i].solve(pose_columns[i] - of.between * inner_columns[of.kind]);
    constrained += of.constraint.transpose() * solved.rightCols<7>();
    in_common += of.constraint.transpose() * (solved.col(0) + Packed(so_far.poses[i]));
  }
  const Vector7 multipliers = Solve(constrained, in_common);

  Step step;
  for (const Columns& solved : inner_columns) step.inner.push_back(solved.col(0) - solved.rightCols<7>() * multipliers);
  std::vector<double> limits(n_kinds, 1);
  for (size_t i = 0; i < n_views; ++i) {
    const size_t kind = system.views[i].kind;
    limits[kind] = std::min(limits[kind], Limit(Displacement(sightings[i], Vector6::Zero(), step.inner[kind])));
  }
  for (size_t kind = 0; kind < n_kinds; ++kind) step.inner[kind] *= limits[kind];
  for (size_t i = 0; i < n_views; ++i) {
    const System::OfView& of = system.views[i];
    const Vector6 pose = solvers[i].solve(of.right - of.constraint * multipliers - of.between * step.inner[of.kind]);
    step.poses.emplace_back(pose * Limit(Displacement(sightings[i], pose, Eigen::Vector3d::Zero())));
  }
  return step;
}

}  // namespace

void TakeOutCommonMotion(const std::vector<View>& given, double distance, std::vector<PoseCorrection>& poses) {
  Matrix7 normal = Matrix7::Zero();
  Vector7 right = Vector7::Zero();
  std::vector<Matrix67> by_similarity;
  for (size_t i = 0; i < poses.size(); ++i) {
    by_similarity.push_back(BySimilarity(given[i]));
    const Matrix67 weighted = PoseWeights(distance).asDiagonal() * by_similarity[i];
    normal += weighted.transpose() * by_similarity[i];
    right += weighted.transpose() * Packed(poses[i]);
  }
  const Vector7 similarity = Solve(normal, right);
  for (size_t i = 0; i < poses.size(); ++i) {
    const Vector6 own = Packed(poses[i]) - by_similarity[i] * similarity;
    poses[i].turn = Array(own.head<3>());
    poses[i].shift = Array(own.tail<3>());
  }
}

CameraUpdate UpdateCameras(const PixelSource& pixels, const std::vector<View>& given, const CameraCorrections& so_far,
                           const RenderTrainingRays& render, const CameraLook& look) {
  const std::vector<std::vector<Sighting>> sightings = Look(pixels, render, look);
  const double distance = SceneDistance(sightings);
  const System system = Linearise(sightings, given, so_far, distance);
  Step step = MinimiseWithoutCommonMotion(system, sightings, so_far);
  for (Vector6& pose : step.poses) pose *= look.gain;
  for (Eigen::Vector3d& inner : step.inner) inner *= look.gain;

  CameraUpdate update{so_far, {}};
  for (size_t kind = 0; kind < step.inner.size(); ++kind) {
    IntrinsicsCorrection& inner = update.corrections.intrinsics[kind];
    inner.log_focal += step.inner[kind][0];
    inner.shift_x += step.inner[kind][1];
    inner.shift_y += step.inner[kind][2];
  }
  for (size_t i = 0; i < step.poses.size(); ++i) {
    update.corrections.poses[i].Append(Array(step.poses[i].head<3>()), Array(step.poses[i].tail<3>()));
  }
  TakeOutCommonMotion(given, distance, update.corrections.poses);  // of second order
  for (size_t i = 0; i < step.poses.size(); ++i) {
    update.displacement_px.push_back(Displacement(sightings[i], Packed(update.corrections.poses[i]),
                                                  Packed(update.corrections.intrinsics[system.views[i].kind])));
  }
  return update;
}

}  // namespace nrff
