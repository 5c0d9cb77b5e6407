#include "sfm/bundle_problem.h"

#include <algorithm>
#include <cmath>

#include "sfm/distortion.h"
#include "sfm/lens_model.h"

namespace nrff {
namespace {

using Eigen::Vector2d;
using Eigen::Vector3d;

constexpr double kLeastDepth = 1e-12;  // baselines: derivatives by what is nearer would grow beyond all numbers

// Images up to which the reduced camera matrix is dense, and sparse; beyond it is never formed.
constexpr size_t kMostDense = 50, kMostSparse = 1000;

template <int kParams>
struct ReprojectionResidual {
  CameraModel model;
  Vector2d px;

  template <typename T>
  bool operator()(const T* rotation, const T* center, const T* point, const T* intrinsics, T* residual) const {
    using Vector = Eigen::Matrix<T, 3, 1>;
    const Eigen::Map<const Eigen::Quaternion<T>> camera_from_frame(rotation);
    const Vector offset = Eigen::Map<const Vector>(point) - Eigen::Map<const Vector>(center);
    const Vector in_camera = camera_from_frame * offset;
    const double x = lens_model::Value(in_camera[0]), y = lens_model::Value(in_camera[1]);
    const double z = lens_model::Value(in_camera[2]);
    if (!(z > kLeastDepth && z * Lens::kLargestRadius > std::hypot(x, y))) {
      residual[0] = residual[1] = T(kUnseen_px);
      return true;
    }
    const int first_distortion = lens_model::FirstDistortion(model);
    const auto distorted = lens_model::Distort<T, T>(model, intrinsics + first_distortion, in_camera[0] / in_camera[2],
                                                     in_camera[1] / in_camera[2]);
    residual[0] = intrinsics[0] * distorted.u + intrinsics[first_distortion - 2] - px.x();
    residual[1] = intrinsics[first_distortion - 3] * distorted.v + intrinsics[first_distortion - 1] - px.y();
    return true;
  }
};

template <int kParams>
std::unique_ptr<ceres::CostFunction> MakeCost(CameraModel model, const Vector2d& px) {
  using Functor = ReprojectionResidual<kParams>;
  return std::make_unique<ceres::AutoDiffCostFunction<Functor, 2, 4, 3, 3, kParams>>(new Functor{model, px});
}

}  // namespace

ColmapCamera Bundle::CameraAt(size_t camera) const {
  const Camera& c = cameras[camera];
  const double* first = Intrinsics(camera);
  return {c.id, c.model, c.width, c.height, {first, first + c.n_params}};
}

std::vector<int> Bundle::HeldAxes(size_t image) const {
  if (IsAnchor(image)) return {0, 1, 2};
  const Component& component = components[images[image].component];
  return component.partner == image ? std::vector{component.fixed_axis} : std::vector<int>{};
}

std::vector<int> Bundle::HeldParams(size_t camera) const {
  std::vector<int> held;
  for (const Group group : {kFocal, kPrincipal, kDistortion}) {
    if (cameras[camera].free[group]) continue;
    const auto [first, last] = GroupRange(cameras[camera].model, group);
    for (int i = first; i < last; ++i) held.push_back(i);
  }
  return held;
}

std::array<int, 2> GroupRange(CameraModel model, Bundle::Group group) {
  const int first_distortion = lens_model::FirstDistortion(model);
  switch (group) {
    case Bundle::kFocal:
      return {0, first_distortion - 2};
    case Bundle::kPrincipal:
      return {first_distortion - 2, first_distortion};
    default:
      return {first_distortion, CameraModelParamCount(model)};
  }
}

void CauchyLoss::Evaluate(double s, double rho[3]) const {
  rho[0] = square_ * std::log1p(s / square_);
  rho[1] = 1 / (1 + s / square_);
  rho[2] = -rho[1] * rho[1] / square_;
}

std::unique_ptr<ceres::CostFunction> ReprojectionCost(CameraModel model, const Vector2d& px) {
  switch (CameraModelParamCount(model)) {
    case 3:
      return MakeCost<3>(model, px);
    case 4:
      return MakeCost<4>(model, px);
    case 5:
      return MakeCost<5>(model, px);
    case 8:
      return MakeCost<8>(model, px);
    default:
      return MakeCost<12>(model, px);
  }
}

Vector2d Residual(const Bundle& bundle, const Bundle::Observation& observation) {
  const size_t camera = bundle.images[observation.image].camera;
  Vector2d residual;
  ReprojectionResidual<0>{bundle.cameras[camera].model, observation.px}(
      bundle.Rotation(observation.image).coeffs().data(), bundle.Center(observation.image).data(),
      bundle.Position(observation.point).data(), bundle.Intrinsics(camera), residual.data());
  return residual;
}

double RobustCost(const Bundle& bundle, double loss_scale_px) {
  const CauchyLoss loss(loss_scale_px);
  double cost = 0;
  for (const Bundle::Observation& observation : bundle.observations) {
    double rho[3];
    loss.Evaluate(Residual(bundle, observation).squaredNorm(), rho);
    cost += rho[0] / 2;
  }
  return cost;
}

ceres::Solver::Summary Solve(Bundle& bundle, double loss_scale_px, const BundleOptions& options) {
  CauchyLoss loss(loss_scale_px);
  ceres::Problem::Options problem_options;
  problem_options.loss_function_ownership = ceres::DO_NOT_TAKE_OWNERSHIP;
  ceres::Problem problem(problem_options);
  auto* ordering = new ceres::ParameterBlockOrdering;
  for (size_t i = 0; i < bundle.points.size(); ++i) {
    problem.AddParameterBlock(bundle.Position(i).data(), 3);
    ordering->AddElementToGroup(bundle.Position(i).data(), 0);
  }
  const auto hold = [&problem](double* block, int size, const std::vector<int>& held) {
    if (int(held.size()) == size)
      problem.SetParameterBlockConstant(block);
    else if (!held.empty())
      problem.SetManifold(block, new ceres::SubsetManifold(size, held));
  };
  for (size_t i = 0; i < bundle.images.size(); ++i) {
    double* rotation = bundle.Rotation(i).coeffs().data();
    problem.AddParameterBlock(rotation, 4, new ceres::EigenQuaternionManifold);
    problem.AddParameterBlock(bundle.Center(i).data(), 3);
    if (bundle.IsAnchor(i)) problem.SetParameterBlockConstant(rotation);
    hold(bundle.Center(i).data(), 3, bundle.HeldAxes(i));
    ordering->AddElementToGroup(rotation, 1);
    ordering->AddElementToGroup(bundle.Center(i).data(), 1);
  }
  for (size_t i = 0; i < bundle.cameras.size(); ++i) {
    double* intrinsics = bundle.Intrinsics(i);
    problem.AddParameterBlock(intrinsics, int(bundle.cameras[i].n_params));
    hold(intrinsics, int(bundle.cameras[i].n_params), bundle.HeldParams(i));
    ordering->AddElementToGroup(intrinsics, 1);
  }
  for (const Bundle::Observation& observation : bundle.observations) {
    const size_t camera = bundle.images[observation.image].camera;
    problem.AddResidualBlock(ReprojectionCost(bundle.cameras[camera].model, observation.px).release(), &loss,
                             bundle.Rotation(observation.image).coeffs().data(),
                             bundle.Center(observation.image).data(), bundle.Position(observation.point).data(),
                             bundle.Intrinsics(camera));
  }

  ceres::Solver::Options solver;
  solver.linear_solver_ordering.reset(ordering);
  solver.linear_solver_type = bundle.images.size() <= kMostDense    ? ceres::DENSE_SCHUR
                              : bundle.images.size() <= kMostSparse ? ceres::SPARSE_SCHUR
                                                                    : ceres::ITERATIVE_SCHUR;
  solver.preconditioner_type = ceres::SCHUR_JACOBI;
  solver.max_num_iterations = options.max_iterations;
  solver.num_threads = options.n_threads;
  // What the last steps still gain is below a thousandth of a standard deviation. Without noise each step gains most of
  // what is left, down to the cost's last digits; from there on none gains any, and the trust region's radius ends it.
  // The length of all parameters, which Ceres would hold a step against, is that of the farthest point.
  solver.function_tolerance = options.least_gain / double(bundle.observations.size());
  solver.parameter_tolerance = 0;
  solver.gradient_tolerance = 0;
  solver.max_trust_region_radius = 1e12;          // its damping keeps the last directions above the sums' rounding
  solver.max_num_consecutive_invalid_steps = 20;  // a lens that is none (0/0 far off the axis) asks for shorter steps
  solver.logging_type = ceres::SILENT;
  ceres::Solver::Summary summary;
  ceres::Solve(solver, &problem, &summary);
  for (size_t i = 0; i < bundle.images.size(); ++i) bundle.Rotation(i).normalize();
  return summary;
}

ColmapModel WithBundle(const ColmapModel& model, const Bundle& bundle) {
  ColmapModel refined = model;
  std::vector<double> units;  // the baseline was 1
  for (const Bundle::Component& component : bundle.components) {
    units.push_back(component.unit / bundle.Center(component.partner).norm());
  }
  const auto world = [&](size_t component, const Vector3d& position) -> Vector3d {
    const Bundle::Component& frame = bundle.components[component];
    return frame.origin + units[component] * (frame.rotation * position);
  };
  for (size_t i = 0; i < bundle.images.size(); ++i) {
    if (bundle.IsAnchor(i)) continue;
    ColmapImage& image = refined.images.at(bundle.images[i].id);
    const Bundle::Component& frame = bundle.components[bundle.images[i].component];
    image.rotation = (bundle.Rotation(i) * frame.rotation.conjugate()).normalized();
    image.translation = -(image.rotation * world(bundle.images[i].component, bundle.Center(i)));
  }
  std::vector<double> sums(bundle.points.size()), counts(bundle.points.size());
  for (const Bundle::Observation& observation : bundle.observations) {
    sums[observation.point] += Residual(bundle, observation).norm();
    ++counts[observation.point];
  }
  for (size_t i = 0; i < bundle.points.size(); ++i) {
    ColmapPoint& point = refined.points.at(bundle.points[i].id);
    point.position = world(bundle.points[i].component, bundle.Position(i));
    point.error_px = sums[i] / counts[i];
  }
  for (size_t i = 0; i < bundle.cameras.size(); ++i) refined.cameras.at(bundle.cameras[i].id) = bundle.CameraAt(i);
  return refined;
}

}  // namespace nrff
