#include "sfm/bundle_information.h"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <Eigen/QR>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "pipeline/statistics.h"

namespace nrff {
namespace {

using Eigen::Index;
using Eigen::Matrix3d;
using Eigen::MatrixXd;
using Eigen::Vector2d;
using Eigen::Vector3d;
using Eigen::VectorXd;

constexpr double kEps = std::numeric_limits<double>::epsilon();
constexpr double kPlanar = 0.01;

// One observation's derivatives by the free directions of its image, camera and point, weighted by √ρ'.
struct Row {
  std::array<Index, 2> offset;               // of the image's and the camera's columns
  std::array<Eigen::Matrix2Xd, 2> jacobian;  // by the image's and by the camera's
  Eigen::Matrix<double, 2, 3> by_point;
  Vector2d residual;
};

std::vector<int> Others(int size, const std::vector<int>& held) {
  std::vector<int> free;
  for (int i = 0; i < size; ++i) {
    if (std::find(held.begin(), held.end(), i) == held.end()) free.push_back(i);
  }
  return free;
}

// Columns of the free directions: images first (turn, then centre), then cameras.
struct Layout {
  std::vector<Index> image, camera;
  std::vector<std::vector<int>> axes, params;  // free ones
  Index size = 0;

  explicit Layout(const Bundle& bundle) {
    for (size_t i = 0; i < bundle.images.size(); ++i) {
      image.push_back(size);
      axes.push_back(Others(3, bundle.HeldAxes(i)));
      if (!bundle.IsAnchor(i)) size += 3 + Index(axes.back().size());
    }
    for (size_t i = 0; i < bundle.cameras.size(); ++i) {
      camera.push_back(size);
      params.push_back(Others(int(bundle.cameras[i].n_params), bundle.HeldParams(i)));
      size += Index(params.back().size());
    }
  }
};

// Derivatives of a rotated vector by a turn δ about the camera's axes: camera_from_frame → exp([δ]) camera_from_frame,
// as columns of xyzw.
Eigen::Matrix<double, 4, 3> TurnBasis(const Eigen::Quaterniond& q) {
  Eigen::Matrix<double, 4, 3> basis;
  for (int axis = 0; axis < 3; ++axis) {
    basis.col(axis) = (Eigen::Quaterniond(0, axis == 0, axis == 1, axis == 2) * q).coeffs() / 2;
  }
  return basis;
}

Row Linearise(const Bundle& bundle, const Layout& layout, const Bundle::Observation& observation,
              const ceres::LossFunction& loss) {
  using RowMajor = Eigen::Matrix<double, 2, Eigen::Dynamic, Eigen::RowMajor>;
  const size_t i = observation.image, k = bundle.images[i].camera;
  const Bundle::Camera& camera = bundle.cameras[k];
  RowMajor by_rotation(2, 4), by_center(2, 3), by_point(2, 3), by_intrinsics(2, camera.n_params);
  const double* values[] = {bundle.Rotation(i).coeffs().data(), bundle.Center(i).data(),
                            bundle.Position(observation.point).data(), bundle.Intrinsics(k)};
  double* jacobians[] = {by_rotation.data(), by_center.data(), by_point.data(), by_intrinsics.data()};
  Row row;
  ReprojectionCost(camera.model, observation.px)->Evaluate(values, row.residual.data(), jacobians);
  double rho[3];
  loss.Evaluate(row.residual.squaredNorm(), rho);
  const double weight = std::sqrt(rho[1]);
  row.residual *= weight;
  row.by_point = weight * by_point;
  row.offset = {layout.image[i], layout.camera[k]};
  if (!bundle.IsAnchor(i)) {
    row.jacobian[0].resize(2, 3 + Index(layout.axes[i].size()));
    row.jacobian[0] << weight * by_rotation * TurnBasis(bundle.Rotation(i)),
        weight * by_center(Eigen::all, layout.axes[i]);
  }
  row.jacobian[1] = weight * by_intrinsics(Eigen::all, layout.params[k]);
  return row;
}

struct Normal {
  MatrixXd reduced;      // points eliminated
  VectorXd gradient;     // reduced
  VectorXd before;       // diagonal with the points held
  VectorXd most;         // largest length of a column over observations, px per unit
  double decrement = 0;  // of the points
};

// Eliminates a point by projecting its rows on what it cannot move [Demmel21]. Products of normal matrices would cancel
// where a point lies close to a camera. A depth that parallel rays do not fix is no column of the point's.
void Eliminate(const std::vector<Row>& rows, Normal& normal) {
  std::vector<Index> columns;  // of `normal`, those the rows touch
  std::vector<std::array<Index, 2>> local(rows.size());
  std::vector<std::pair<Index, Index>> segments;  // offset in `normal` and here
  for (size_t i = 0; i < rows.size(); ++i) {
    for (size_t part = 0; part < 2; ++part) {
      const Index offset = rows[i].offset[part], size = rows[i].jacobian[part].cols();
      const auto same = std::find_if(segments.begin(), segments.end(),
                                     [offset](const auto& segment) { return segment.first == offset; });
      local[i][part] = same == segments.end() ? Index(columns.size()) : same->second;
      if (same != segments.end() || size == 0) continue;
      segments.emplace_back(offset, Index(columns.size()));
      for (Index column = 0; column < size; ++column) columns.push_back(offset + column);
    }
  }
  const auto n_rows = Index(2 * rows.size());
  MatrixXd by_cameras = MatrixXd::Zero(n_rows, Index(columns.size()));
  Eigen::MatrixX3d by_point(n_rows, 3);
  VectorXd residual(n_rows);
  for (size_t i = 0; i < rows.size(); ++i) {
    const auto row = Index(2 * i);
    by_point.middleRows<2>(row) = rows[i].by_point;
    residual.segment<2>(row) = rows[i].residual;
    for (size_t part = 0; part < 2; ++part) {
      const Eigen::Matrix2Xd& jacobian = rows[i].jacobian[part];
      by_cameras.block(row, local[i][part], 2, jacobian.cols()) = jacobian;
      auto most = normal.most.segment(rows[i].offset[part], jacobian.cols());
      most = most.cwiseMax(jacobian.colwise().norm().transpose());
    }
  }
  normal.before(columns) += by_cameras.colwise().squaredNorm().transpose();
  for (int i = 0; i < 3; ++i) {
    const double length = by_point.col(i).norm();
    if (length > 0) by_point.col(i) /= length;
  }
  Eigen::ColPivHouseholderQR<Eigen::MatrixX3d> factors;
  factors.setThreshold(8 * 3 * kEps);
  factors.compute(by_point);
  const auto rotation = factors.householderQ().setLength(factors.nonzeroPivots()).adjoint();
  by_cameras.applyOnTheLeft(rotation);
  residual.applyOnTheLeft(rotation);
  const Index rank = factors.rank();
  normal.decrement += residual.head(rank).squaredNorm();
  const auto left = by_cameras.bottomRows(n_rows - rank);
  normal.reduced(columns, columns) += left.transpose() * left;
  normal.gradient(columns) += left.transpose() * residual.tail(n_rows - rank);
}

Normal Reduce(const Bundle& bundle, const Layout& layout, double loss_scale_px) {
  const CauchyLoss loss(loss_scale_px);
  Normal normal{MatrixXd::Zero(layout.size, layout.size), VectorXd::Zero(layout.size), VectorXd::Zero(layout.size),
                VectorXd::Zero(layout.size)};
  std::vector<Row> rows;
  for (size_t i = 0; i < bundle.observations.size(); ++i) {
    rows.push_back(Linearise(bundle, layout, bundle.observations[i], loss));
    const bool last = i + 1 == bundle.observations.size();
    if (!last && bundle.observations[i + 1].point == bundle.observations[i].point) continue;
    Eliminate(rows, normal);
    rows.clear();
  }
  return normal;
}

// The open directions' squares over `columns` columns from `offset`.
double Share(const MatrixXd& directions, Index offset, Index columns) {
  return directions.middleRows(offset, columns).squaredNorm() / double(directions.cols());
}

// Free parameters of a group, as positions among the camera's free ones.
std::vector<Index> GroupColumns(const Bundle& bundle, const Layout& layout, size_t camera, Bundle::Group group) {
  const auto [first, last] = GroupRange(bundle.cameras[camera].model, group);
  std::vector<Index> columns;
  for (size_t i = 0; i < layout.params[camera].size(); ++i) {
    const int param = layout.params[camera][i];
    if (param >= first && param < last) columns.push_back(layout.camera[camera] + Index(i));
  }
  return columns;
}

VectorXd OpenShares(const Bundle& bundle, const Layout& layout, const MatrixXd& directions) {
  VectorXd open = VectorXd::Zero(Index(bundle.images.size() + bundle.cameras.size() * Bundle::kGroups));
  for (size_t i = 0; i < bundle.images.size(); ++i) {
    const Index columns = bundle.IsAnchor(i) ? 0 : 3 + Index(layout.axes[i].size());
    open[Index(i)] = Share(directions, layout.image[i], columns);
  }
  for (size_t k = 0; k < bundle.cameras.size(); ++k) {
    for (const auto group : {Bundle::kFocal, Bundle::kPrincipal, Bundle::kDistortion}) {
      for (const Index column : GroupColumns(bundle, layout, k, group)) {
        open[Index(bundle.images.size() + k * Bundle::kGroups + group)] += Share(directions, column, 1);
      }
    }
  }
  return open;
}

std::vector<PoseCovariance> Covariances(const Bundle& bundle, const Layout& layout, const MatrixXd& covariance) {
  std::vector<PoseCovariance> covariances;
  for (size_t i = 0; i < bundle.images.size(); ++i) {
    PoseCovariance& pose = covariances.emplace_back();
    pose.image = bundle.images[i].id;
    if (bundle.IsAnchor(i)) continue;
    const Index offset = layout.image[i];
    pose.rotation = covariance.block<3, 3>(offset, offset);
    for (size_t a = 0; a < layout.axes[i].size(); ++a) {
      for (size_t b = 0; b < layout.axes[i].size(); ++b) {
        pose.position(layout.axes[i][a], layout.axes[i][b]) = covariance(offset + 3 + Index(a), offset + 3 + Index(b));
      }
    }
  }
  return covariances;
}

}  // namespace

BundleInformation MeasureInformation(const Bundle& bundle, double loss_scale_px) {
  const Layout layout(bundle);
  const Normal normal = Reduce(bundle, layout, loss_scale_px);
  BundleInformation information;
  information.n_free = size_t(layout.size) + 3 * bundle.points.size();
  information.decrement = normal.decrement;
  VectorXd scale(layout.size);
  for (Index i = 0; i < layout.size; ++i) {
    const double rounding = std::pow(double(layout.size) * kEps, 2) * normal.before[i];  // of what cancels to nothing
    const double diagonal = normal.reduced(i, i) > rounding ? normal.reduced(i, i) : normal.before[i];
    scale[i] = diagonal > 0 ? 1 / std::sqrt(diagonal) : 1;
  }
  const MatrixXd scaled = scale.asDiagonal() * normal.reduced * scale.asDiagonal();
  const double tolerance = 8 * double(layout.size) * kEps;
  const Eigen::LLT<MatrixXd> cholesky(scaled);
  // Its estimate is within a factor of the size: where it is far from the tolerance, the eigenvalues need not be found.
  if (cholesky.info() != Eigen::Success || cholesky.rcond() < double(layout.size) * tolerance) {
    const Eigen::SelfAdjointEigenSolver<MatrixXd> eigen(scaled);
    const Index n_open = (eigen.eigenvalues().array() <= tolerance).count();
    if (n_open > 0 || cholesky.info() != Eigen::Success) {
      information.has_rank = false;
      information.open = OpenShares(bundle, layout, eigen.eigenvectors().leftCols(std::max<Index>(n_open, 1)));
      return information;
    }
  }
  const MatrixXd covariance =
      scale.asDiagonal() * cholesky.solve(MatrixXd::Identity(layout.size, layout.size)) * scale.asDiagonal();
  information.decrement += normal.gradient.dot(covariance * normal.gradient);
  information.covariances = Covariances(bundle, layout, covariance);
  information.spread = VectorXd::Zero(Index(bundle.cameras.size() * Bundle::kGroups));
  for (size_t k = 0; k < bundle.cameras.size(); ++k) {
    for (const auto group : {Bundle::kFocal, Bundle::kPrincipal, Bundle::kDistortion}) {
      double& spread = information.spread[Index(k * Bundle::kGroups + group)];
      for (const Index column : GroupColumns(bundle, layout, k, group)) {
        spread = std::max(spread, std::sqrt(std::max(0.0, covariance(column, column))) * normal.most[column]);
      }
    }
  }
  return information;
}

std::optional<std::string> NamedDegeneracy(const Bundle& bundle, double angle) {
  // Angles between unit vectors by their difference: exact where they are small.
  std::vector<Vector3d> first_ray(bundle.points.size(), Vector3d::Zero());
  std::vector<double> parallax(bundle.points.size());
  std::vector<Vector3d> first_view(bundle.images.size(), Vector3d::Zero());
  std::vector<double> extent(bundle.images.size());
  for (const Bundle::Observation& o : bundle.observations) {
    const Vector3d ray = (bundle.Position(o.point) - bundle.Center(o.image)).normalized();
    if (first_ray[o.point].isZero(0)) first_ray[o.point] = ray;
    parallax[o.point] = std::max(parallax[o.point], (ray - first_ray[o.point]).norm());
    if (first_view[o.image].isZero(0)) first_view[o.image] = ray;
    extent[o.image] = std::max(extent[o.image], (ray - first_view[o.image]).norm());
  }
  if (!(Median(extent) > angle)) {
    return "all points at one place: in most images they lie within the observations' own deviation";
  }
  if (!(Median(parallax) > angle)) {
    return "rotation only: the rays to most points are parallel but for the observations' own deviation, so that no "
           "baseline fixes their distances";
  }
  return {};
}

namespace {

constexpr double kMostOtherwise = 0.1;  // of points or images
constexpr double kStraight = 0.05;
constexpr double kForward_rad = 15 * M_PI / 180, kAlike_rad = M_PI / 180;

// Mean and principal axes (ascending extents) of points.
struct Spread {
  Vector3d mean = Vector3d::Zero();
  Matrix3d axes = Matrix3d::Identity();
  Vector3d extents = Vector3d::Zero();  // root mean squares

  explicit Spread(const std::vector<Vector3d>& points) {
    for (const Vector3d& point : points) mean += point / double(points.size());
    Matrix3d squares = Matrix3d::Zero();
    for (const Vector3d& point : points) squares += (point - mean) * (point - mean).transpose() / double(points.size());
    const Eigen::SelfAdjointEigenSolver<Matrix3d> eigen(squares);
    axes = eigen.eigenvectors();
    extents = eigen.eigenvalues().cwiseMax(0).cwiseSqrt();
  }
};

// The share of `values` that is beyond `most`.
double Beyond(const std::vector<double>& values, double most) {
  const auto n = std::count_if(values.begin(), values.end(), [most](double value) { return !(value <= most); });
  return double(n) / double(std::max<size_t>(1, values.size()));
}

// Refits to the nearer half until all but a few points lie on the plane, or it is clear that they do not.
bool IsPlanar(const std::vector<Vector3d>& points) {
  constexpr int kRefits = 10;
  constexpr size_t kFewest = 4;
  if (points.size() < kFewest) return false;
  std::vector<Vector3d> kept = points;
  for (int refit = 0; refit < kRefits; ++refit) {
    const Spread spread(kept);
    std::vector<double> across;
    for (const Vector3d& point : points) across.push_back(std::abs(spread.axes.col(0).dot(point - spread.mean)));
    if (Beyond(across, kPlanar * spread.extents[1]) <= kMostOtherwise) return true;
    const double nearer = Median(across);
    kept.clear();
    for (size_t i = 0; i < points.size(); ++i) {
      if (across[i] <= nearer) kept.push_back(points[i]);
    }
  }
  return false;
}

bool IsForward(const std::vector<Vector3d>& centers, const std::vector<Vector3d>& views) {
  if (centers.size() < 3) return false;
  const Spread spread(centers);
  if (!(spread.extents[1] <= kStraight * spread.extents[2])) return false;
  std::vector<double> aside;
  for (const Vector3d& view : views) {
    aside.push_back(std::acos(std::min(1.0, std::abs(spread.axes.col(2).dot(view)))));
  }
  return Beyond(aside, kForward_rad) <= kMostOtherwise;
}

}  // namespace

std::vector<std::string> NamedStructure(const Bundle& bundle) {
  bool planar = true, forward = true, alike = true;
  for (size_t c = 0; c < bundle.components.size(); ++c) {
    std::vector<Vector3d> points, centers, views;
    std::vector<double> turned;
    const Eigen::Quaterniond anchor(bundle.Rotation(bundle.components[c].anchor));
    for (size_t i = 0; i < bundle.points.size(); ++i) {
      if (bundle.points[i].component == c) points.emplace_back(bundle.Position(i));
    }
    for (size_t i = 0; i < bundle.images.size(); ++i) {
      if (bundle.images[i].component != c) continue;
      const Eigen::Quaterniond rotation(bundle.Rotation(i));
      centers.emplace_back(bundle.Center(i));
      views.emplace_back(rotation.conjugate() * Vector3d::UnitZ());
      turned.push_back(rotation.angularDistance(anchor));
    }
    planar &= IsPlanar(points);
    forward &= IsForward(centers, views);
    alike &= centers.size() > 1 && Beyond(turned, kAlike_rad) <= kMostOtherwise;
  }
  std::vector<std::string> structure;
  if (bundle.components.empty()) return structure;
  if (planar) structure.emplace_back("planar: the points lie on a plane");
  if (forward) structure.emplace_back("forward motion: the cameras move along their viewing direction");
  if (alike) structure.emplace_back("no turning: the cameras all look the same way");
  return structure;
}

}  // namespace nrff
