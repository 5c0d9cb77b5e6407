#include "sfm/trajectory_errors.h"

#include <ceres/ceres.h>
#include <ceres/rotation.h>

#include <Eigen/SVD>
#include <algorithm>
#include <cmath>
#include <iomanip>
#include <limits>
#include <random>
#include <sstream>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/statistics.h"

namespace nrff {
namespace {

constexpr double kDegrees = 180 / M_PI;
constexpr int kSimilarityTrials =
    500;  // the best of so many triples has three good ones in it (half of them bad: 1 − 1e-28)
constexpr double kLineTolerance = 1e-6;               // second over first extent of what counts as a line
constexpr double kPointTolerance = 1e-12;             // baseline over extent of what has no direction
constexpr double kAngles[] = {0.5, 1, 3, 5, 10, 20};  // degrees
constexpr double kShares[] = {0.001, 0.002, 0.005, 0.01, 0.02, 0.05};  // of the radius

struct Similarity {
  double scale = 1;
  Eigen::Quaterniond rotation = Eigen::Quaterniond::Identity();
  Eigen::Vector3d translation = Eigen::Vector3d::Zero();

  Eigen::Vector3d operator*(const Eigen::Vector3d& point) const { return scale * (rotation * point) + translation; }
  Eigen::Matrix4d Matrix() const {
    Eigen::Matrix4d matrix = Eigen::Matrix4d::Identity();
    matrix.topLeftCorner<3, 3>() = scale * rotation.toRotationMatrix();
    matrix.topRightCorner<3, 1>() = translation;
    return matrix;
  }
};

// Matched centres as columns.
struct Centers {
  Eigen::Matrix3Xd estimated, truth;
};

Centers MatchedCenters(const Trajectory& estimated, const Trajectory& truth, const Matches& matches) {
  Centers centers{Eigen::Matrix3Xd(3, matches.pairs.size()), Eigen::Matrix3Xd(3, matches.pairs.size())};
  for (size_t i = 0; i < matches.pairs.size(); ++i) {
    centers.estimated.col(Eigen::Index(i)) = estimated[matches.pairs[i].first].center;
    centers.truth.col(Eigen::Index(i)) = truth[matches.pairs[i].second].center;
  }
  return centers;
}

std::vector<double> Distances(const Similarity& similarity, const Centers& centers) {
  std::vector<double> distances;
  for (Eigen::Index i = 0; i < centers.truth.cols(); ++i) {
    distances.push_back((similarity * centers.estimated.col(i) - centers.truth.col(i)).norm());
  }
  return distances;
}

// Extents of the centres about their mean along their principal directions, descending.
Eigen::Vector3d Extents(const Eigen::Matrix3Xd& centers) {
  const Eigen::Matrix3Xd centred = centers.colwise() - centers.rowwise().mean();
  const Eigen::VectorXd values = Eigen::JacobiSVD<Eigen::Matrix3Xd>(centred).singularValues();
  Eigen::Vector3d extents = Eigen::Vector3d::Zero();  // two centres have two
  extents.head(values.size()) = values;
  return extents;
}

Similarity FromMatrix(const Eigen::Matrix4d& matrix) {
  Similarity similarity;
  const Eigen::Matrix3d linear = matrix.topLeftCorner<3, 3>();
  similarity.scale = std::cbrt(linear.determinant());
  similarity.rotation = Eigen::Quaterniond(linear / similarity.scale).normalized();
  similarity.translation = matrix.topRightCorner<3, 1>();
  return similarity;
}

// The rotation nearest to all truth_from_estimated of the cameras themselves, and scale and translation by medians: a
// start that needs no spread of the centres.
Similarity FromRotations(const Trajectory& estimated, const Trajectory& truth, const Matches& matches,
                         const Centers& centers) {
  Eigen::Matrix3d sum = Eigen::Matrix3d::Zero();
  for (const auto& [e, t] : matches.pairs) {
    sum += (truth[t].rotation * estimated[e].rotation.conjugate()).toRotationMatrix();
  }
  const Eigen::JacobiSVD<Eigen::Matrix3d> svd(sum, Eigen::ComputeFullU | Eigen::ComputeFullV);
  Eigen::Vector3d signs(1, 1, (svd.matrixU() * svd.matrixV().transpose()).determinant() < 0 ? -1 : 1);
  Similarity similarity;
  similarity.rotation = Eigen::Quaterniond(svd.matrixU() * signs.asDiagonal() * svd.matrixV().transpose());
  const auto middle = [](const Eigen::Matrix3Xd& points) {
    Eigen::Vector3d median;
    for (int axis = 0; axis < 3; ++axis) {
      const Eigen::VectorXd row = points.row(axis);
      median[axis] = Median({row.begin(), row.end()});
    }
    return median;
  };
  const Eigen::Vector3d from = middle(centers.estimated), to = middle(centers.truth);
  struct Spread {
    double median, rms;
  };
  const auto spread = [](const Eigen::Matrix3Xd& points, const Eigen::Vector3d& about) {
    const Eigen::VectorXd distances = (points.colwise() - about).colwise().norm().transpose();
    return Spread{Median({distances.begin(), distances.end()}), distances.norm()};
  };
  const Spread wide = spread(centers.estimated, from), true_wide = spread(centers.truth, to);
  // Where more than half of the cameras stand at one point, the others tell.
  const bool by_median = wide.median > 0 && true_wide.median > 0;
  similarity.scale = by_median ? true_wide.median / wide.median : true_wide.rms / wide.rms;
  similarity.translation = to - similarity.scale * (similarity.rotation * from);
  return similarity;
}

// The similarity of smallest median distance among those of random triples, of all centres, and `start`.
Similarity LeastMedian(const Centers& centers, const Similarity& start) {
  Similarity best = start;
  double least = Median(Distances(start, centers));
  const auto consider = [&](const Eigen::Matrix3Xd& from, const Eigen::Matrix3Xd& to) {
    const Eigen::Vector3d extents = Extents(from);
    if (extents[1] <= kLineTolerance * extents[0]) return;
    const Eigen::Matrix4d matrix = Eigen::umeyama(from, to);
    if (!matrix.allFinite() || !(matrix.topLeftCorner<3, 3>().determinant() > 1e-30)) return;
    const Similarity similarity = FromMatrix(matrix);
    const double median = Median(Distances(similarity, centers));
    if (median < least) least = median, best = similarity;
  };
  consider(centers.estimated, centers.truth);
  const Eigen::Index n = centers.truth.cols();
  std::mt19937 random(1);
  for (int trial = 0; trial < kSimilarityTrials && n > 3; ++trial) {
    Eigen::Matrix3Xd from(3, 3), to(3, 3);
    for (int k = 0; k < 3; ++k) {
      const auto i = Eigen::Index(random() % uint64_t(n));
      from.col(k) = centers.estimated.col(i);
      to.col(k) = centers.truth.col(i);
    }
    consider(from, to);
  }
  return best;
}

// (scale·R·estimated + translation − truth) / sigma
struct CenterResidual {
  Eigen::Vector3d estimated, truth;
  double sigma;

  template <typename T>
  bool operator()(const T* log_scale, const T* rotation, const T* translation, T* residual) const {
    using Vector = Eigen::Matrix<T, 3, 1>;
    const Eigen::Map<const Eigen::Quaternion<T>> q(rotation);
    const Vector moved = exp(log_scale[0]) * (q * estimated.cast<T>()) + Eigen::Map<const Vector>(translation);
    Eigen::Map<Vector>{residual} = (moved - truth.cast<T>()) / T(sigma);
    return true;
  }
};

// Angle-axis between the true rotation and the moved estimated one, radians over sigma.
struct RotationResidual {
  Eigen::Quaterniond estimated, truth;
  double sigma;

  template <typename T>
  bool operator()(const T* rotation, T* residual) const {
    const Eigen::Map<const Eigen::Quaternion<T>> q(rotation);
    const Eigen::Quaternion<T> error = truth.cast<T>().conjugate() * q * estimated.cast<T>();
    const T wxyz[4] = {error.w(), error.x(), error.y(), error.z()};
    ceres::QuaternionToAngleAxis(wxyz, residual);
    for (int i = 0; i < 3; ++i) residual[i] /= T(sigma);
    return true;
  }
};

double AngleDegrees(const Eigen::Quaterniond& a, const Eigen::Quaterniond& b) {
  return a.angularDistance(b) * kDegrees;
}

double AngleDegrees(const Eigen::Vector3d& a, const Eigen::Vector3d& b) {
  return std::atan2(a.cross(b).norm(), a.dot(b)) * kDegrees;
}

Eigen::Vector3d InCamera(const TrajectoryPose& pose, const Eigen::Vector3d& point) {
  return pose.rotation.conjugate() * (point - pose.center);
}

Json Statistics(const std::vector<double>& values) {
  double sum = 0, squares = 0, most = 0;
  for (const double value : values) {
    sum += value;
    squares += value * value;
    most = std::max(most, value);
  }
  if (values.empty()) return {{"median", nullptr}, {"mean", nullptr}, {"rms", nullptr}, {"max", nullptr}};
  const auto n = double(values.size());
  return {{"median", Median(values)}, {"mean", sum / n}, {"rms", std::sqrt(squares / n)}, {"max", most}};
}

std::string Number(double value) {
  std::ostringstream text;
  text << value;
  return text.str();
}

// Errors of what is there, and without bound of the `n_missing` that are not.
template <typename Thresholds>
Json Areas(std::vector<double> errors, size_t n_missing, const Thresholds& thresholds, double unit,
           const char* suffix) {
  errors.resize(errors.size() + n_missing, std::numeric_limits<double>::infinity());
  Json areas = Json::object();
  for (const double threshold : thresholds) {
    areas[Number(threshold * unit) + suffix] = AreaUnderRecall(errors, threshold);
  }
  return areas;
}

struct RelativeErrors {
  std::vector<double> rotation, direction, both;  // degrees
};

RelativeErrors OfPairs(const Trajectory& estimated, const Trajectory& truth, const Matches& matches, double radius) {
  RelativeErrors errors;
  double extent = 0;  // of the estimated centres
  for (const TrajectoryPose& pose : estimated) {
    extent = std::max(extent, (pose.center - estimated.front().center).norm());
  }
  for (size_t i = 0; i < matches.pairs.size(); ++i) {
    for (size_t j = i + 1; j < matches.pairs.size(); ++j) {
      const TrajectoryPose &ei = estimated[matches.pairs[i].first], &ej = estimated[matches.pairs[j].first];
      const TrajectoryPose &ti = truth[matches.pairs[i].second], &tj = truth[matches.pairs[j].second];
      const double rotation =
          AngleDegrees(ei.rotation.conjugate() * ej.rotation, ti.rotation.conjugate() * tj.rotation);
      errors.rotation.push_back(rotation);
      errors.both.push_back(rotation);
      const Eigen::Vector3d true_baseline = ti.rotation.conjugate() * (tj.center - ti.center);
      if (true_baseline.norm() <= kPointTolerance * radius) continue;  // no direction to be wrong about
      const Eigen::Vector3d baseline = ei.rotation.conjugate() * (ej.center - ei.center);
      const bool collapsed = baseline.norm() <= kPointTolerance * extent;
      const double direction = collapsed ? 180 : AngleDegrees(baseline, true_baseline);
      errors.direction.push_back(direction);
      errors.both.back() = std::max(rotation, direction);
    }
  }
  return errors;
}

std::string FileName(const std::string& name) { return std::filesystem::path(name).filename().string(); }

// Both sorted by what `key` makes of names; names that are there twice match nothing.
template <typename Key>
Matches MatchBy(const Trajectory& estimated, const Trajectory& truth, const char* by, const Key& key) {
  std::map<std::string, std::vector<size_t>> of_estimated, of_truth;
  for (size_t i = 0; i < estimated.size(); ++i) of_estimated[key(estimated[i].name)].push_back(i);
  for (size_t i = 0; i < truth.size(); ++i) of_truth[key(truth[i].name)].push_back(i);
  Matches matches;
  matches.by = by;
  for (const auto& [name, indices] : of_estimated) {
    const auto other = of_truth.find(name);
    if (other == of_truth.end() || indices.size() > 1 || other->second.size() > 1) continue;
    matches.pairs.emplace_back(indices.front(), other->second.front());
  }
  return matches;
}

}  // namespace

Matches MatchPoses(const Trajectory& estimated, const Trajectory& truth) {
  Matches by_name = MatchBy(estimated, truth, "name", [](const std::string& name) { return name; });
  Matches by_file = MatchBy(estimated, truth, "file name", FileName);
  if (!by_name.pairs.empty() && by_name.pairs.size() >= by_file.pairs.size()) return by_name;
  if (!by_file.pairs.empty()) return by_file;
  Matches by_order;
  by_order.by = "order";
  if (estimated.size() != truth.size()) return by_order;
  for (size_t i = 0; i < truth.size(); ++i) by_order.pairs.emplace_back(i, i);
  return by_order;
}

Eigen::Matrix4d AlignTrajectories(const Trajectory& estimated, const Trajectory& truth, const Matches& matches) {
  if (matches.pairs.size() < 2) {
    throw InputError("Only " + std::to_string(matches.pairs.size()) + " of " + std::to_string(estimated.size()) +
                     " estimated poses belong to one of the " + std::to_string(truth.size()) +
                     " true ones; at least two are needed. Names without extension have to be the same.");
  }
  Centers centers = MatchedCenters(estimated, truth, matches);
  // Unit extents about the origin, so that nothing below depends on units or on where the world's origin lies.
  struct Frame {
    Eigen::Vector3d center;
    double extent;
  };
  const auto normalise = [](Eigen::Matrix3Xd& points, const char* which) {
    const Eigen::Vector3d center = points.rowwise().mean();
    points.colwise() -= center;
    const double extent = points.colwise().norm().maxCoeff();
    if (!(extent > 1e-14 * center.norm())) {
      throw InputError(std::string("All ") + which + " camera centres are one point; no scale can be found.");
    }
    points /= extent;
    return Frame{center, extent};
  };
  const Frame from = normalise(centers.estimated, "estimated"), to = normalise(centers.truth, "true");

  const Similarity from_rotations = FromRotations(estimated, truth, matches, centers);
  Similarity similarity = LeastMedian(centers, from_rotations);
  const auto deviation = [&] { return std::max(1.4826 * Median(Distances(similarity, centers)), 1e-12); };
  const Eigen::Vector3d extents = Extents(centers.truth);
  const double width = extents[1] / std::sqrt(double(centers.truth.cols()));
  const bool on_a_line = extents[1] <= kLineTolerance * extents[0] || width < 3 * deviation();
  if (on_a_line) similarity = from_rotations;
  double log_scale = std::log(similarity.scale);
  const double sigma = deviation();
  std::vector<double> angles;
  for (const auto& [e, t] : matches.pairs) {
    angles.push_back((similarity.rotation * estimated[e].rotation).angularDistance(truth[t].rotation));
  }
  const double sigma_angle = std::max(1.4826 * Median(angles), 1e-9);
  ceres::Problem problem;
  problem.AddParameterBlock(similarity.rotation.coeffs().data(), 4, new ceres::EigenQuaternionManifold());
  for (Eigen::Index i = 0; i < centers.truth.cols(); ++i) {
    problem.AddResidualBlock(new ceres::AutoDiffCostFunction<CenterResidual, 3, 1, 4, 3>(
                                 new CenterResidual{centers.estimated.col(i), centers.truth.col(i), sigma}),
                             new ceres::CauchyLoss(1), &log_scale, similarity.rotation.coeffs().data(),
                             similarity.translation.data());
    if (!on_a_line) continue;
    const auto& [e, t] = matches.pairs[size_t(i)];
    problem.AddResidualBlock(new ceres::AutoDiffCostFunction<RotationResidual, 3, 4>(
                                 new RotationResidual{estimated[e].rotation, truth[t].rotation, sigma_angle}),
                             new ceres::CauchyLoss(1), similarity.rotation.coeffs().data());
  }
  ceres::Solver::Options options;
  options.linear_solver_type = ceres::DENSE_QR;
  options.max_num_iterations = 200;
  options.function_tolerance = 1e-14;
  options.gradient_tolerance = 1e-14;
  options.parameter_tolerance = 1e-14;
  options.logging_type = ceres::SILENT;
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem, &summary);
  if (!summary.IsSolutionUsable())
    throw InputError("The trajectories could not be aligned (" + summary.message +
                     "); check that their poses are of the same photos.");
  similarity.scale = std::exp(log_scale);
  similarity.rotation.normalize();

  // Back to the worlds' own units: x ↦ to.extent·(S·(x − from.center)/from.extent) + to.center
  Similarity world = similarity;
  world.scale = similarity.scale * to.extent / from.extent;
  world.translation =
      to.extent * similarity.translation + to.center - world.scale * (similarity.rotation * from.center);
  return world.Matrix();
}

double AreaUnderRecall(const std::vector<double>& errors, double threshold) {
  if (errors.empty()) return 0;
  double sum = 0;
  for (const double error : errors) sum += std::max(0.0, 1 - error / threshold);
  return sum / double(errors.size());
}

Json TrajectoryErrors(const Trajectory& estimated, const Trajectory& truth, const CropVolume* object) {
  const Matches matches = MatchPoses(estimated, truth);
  const Eigen::Matrix4d truth_from_estimated = AlignTrajectories(estimated, truth, matches);
  const Trajectory aligned = Transformed(estimated, truth_from_estimated);

  Eigen::Vector3d mean = Eigen::Vector3d::Zero();
  for (const TrajectoryPose& pose : truth) mean += pose.center / double(truth.size());
  double squares = 0;
  for (const TrajectoryPose& pose : truth) squares += (pose.center - mean).squaredNorm() / double(truth.size());
  const double radius = std::sqrt(squares);

  std::vector<double> positions, rotations;
  for (const auto& [e, t] : matches.pairs) {
    positions.push_back((aligned[e].center - truth[t].center).norm() / radius);
    rotations.push_back(AngleDegrees(aligned[e].rotation, truth[t].rotation));
  }
  const RelativeErrors relative = OfPairs(estimated, truth, matches, radius);
  const size_t n_missing = truth.size() - matches.pairs.size();
  const size_t n_missing_pairs = truth.size() * (truth.size() - 1) / 2 - relative.both.size();

  Json position = Statistics(positions), rotation = Statistics(rotations);
  position["auc"] = Areas(positions, n_missing, kShares, 100, "%");
  rotation["auc"] = Areas(rotations, n_missing, kAngles, 1, "");
  Json matrix = Json::array();
  for (int i = 0; i < 16; ++i) matrix.push_back(truth_from_estimated(i / 4, i % 4));
  Json errors = {{"n_true", truth.size()},
                 {"n_estimated", estimated.size()},
                 {"n_matched", matches.pairs.size()},
                 {"matched_by", matches.by},
                 {"radius", radius},
                 {"position", position},
                 {"rotation_deg", rotation},
                 {"relative_deg",
                  {{"rotation", Statistics(relative.rotation)},
                   {"direction", Statistics(relative.direction)},
                   {"auc", Areas(relative.both, n_missing_pairs, kAngles, 1, "")}}},
                 {"truth_from_estimated", matrix}};
  if (object != nullptr) {
    std::vector<double> angles;
    for (const auto& [e, t] : matches.pairs) {
      for (const Eigen::Vector3d& corner : object->Corners()) {
        angles.push_back(AngleDegrees(InCamera(aligned[e], corner), InCamera(truth[t], corner)));
      }
    }
    errors["object_deg"] = Statistics(angles);
  }
  return errors;
}

std::string TrajectoryErrorsText(const Json& errors) {
  std::ostringstream text;
  const auto figure = [](const Json& value, double unit = 1) {
    if (!value.is_number()) return std::string("none");
    std::ostringstream number;
    number << std::setprecision(3) << value.get<double>() * unit;
    return number.str();
  };
  const auto row = [&](const char* name, const Json& statistics, double unit, const char* suffix) {
    text << name;
    for (const char* key : {"median", "mean", "max"}) {
      text << "  " << key << ' ' << figure(statistics.at(key), unit) << suffix;
    }
    text << '\n';
  };
  const auto areas = [&](const char* name, const Json& values, const char* suffix) {
    text << name;
    std::vector<std::pair<double, std::string>> sorted;
    for (const auto& [threshold, area] : values.items()) {
      sorted.emplace_back(std::stod(threshold), threshold + suffix + " " + figure(area));
    }
    std::sort(sorted.begin(), sorted.end());
    for (const auto& [threshold, shown] : sorted) text << "  " << shown;
    text << '\n';
  };
  text << "poses      " << errors.at("n_matched").get<size_t>() << " of " << errors.at("n_true").get<size_t>()
       << " true ones estimated, matched by " << errors.at("matched_by").get<std::string>() << '\n';
  row("position ", errors.at("position"), 100, " %");
  row("rotation ", errors.at("rotation_deg"), 1, "°");
  if (errors.contains("object_deg")) row("object   ", errors.at("object_deg"), 1, "°");
  row("relative rotation ", errors.at("relative_deg").at("rotation"), 1, "°");
  row("relative direction", errors.at("relative_deg").at("direction"), 1, "°");
  areas("position AUC", errors.at("position").at("auc"), "");
  areas("rotation AUC", errors.at("rotation_deg").at("auc"), "°");
  areas("relative AUC", errors.at("relative_deg").at("auc"), "°");
  text << "positions in % of the true centres' rms distance from their mean, " << figure(errors.at("radius"))
       << " true units\n";
  return text.str();
}

}  // namespace nrff
