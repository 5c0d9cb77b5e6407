#include "sfm/bundle_refinement.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <numeric>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/statistics.h"
#include "sfm/bundle_information.h"
#include "sfm/bundle_problem.h"
#include "sfm/distortion.h"

namespace nrff {
namespace {

constexpr double kLargestSpread = 0.1;      // of the image's longer side: a deviation of that much says nothing
constexpr double kLeastShare = 1e-6;        // of an open direction: far above what rounding mixes in
constexpr double kConverged = 0.01;         // standard deviations between here and the minimum
constexpr double kRayleighMedian = 1.1774;  // of the length of two coordinates of deviation 1
constexpr double kEps = std::numeric_limits<double>::epsilon();
constexpr const char* kGroupNames[] = {"focal length", "principal point", "distortion"};

std::vector<double> Errors(const Bundle& bundle) {
  std::vector<double> errors;
  errors.reserve(bundle.observations.size());
  for (const Bundle::Observation& o : bundle.observations) errors.push_back(Residual(bundle, o).norm());
  return errors;
}

ReprojectionErrors Summarise(const std::vector<double>& errors) {
  return {Median(errors), std::accumulate(errors.begin(), errors.end(), 0.0) / double(errors.size())};
}

// What a projection's arithmetic leaves of an image's coordinates, px.
double RoundingPx(const Bundle& bundle) {
  double side = 0;
  for (const Bundle::Camera& camera : bundle.cameras)
    side = std::max<double>({side, double(camera.width), double(camera.height)});
  return 64 * kEps * side;
}

// Of one coordinate, as the residuals' median tells; outliers do not count in it.
double DeviationPx(const Bundle& bundle, size_t n_free) {
  const auto n = double(2 * bundle.observations.size());
  const double redundant = std::max(1.0, n - double(n_free));
  return std::max(RoundingPx(bundle), Median(Errors(bundle)) / kRayleighMedian * std::sqrt(n / redundant));
}

// Holds the least important intrinsics of those that the data do not fix, whatever camera they are of. False where all
// free ones are fixed.
bool HoldUnfixed(Bundle& bundle, const BundleInformation& information, double deviation_px,
                 std::vector<std::string>& held) {
  bool any = false;
  for (const auto group : {Bundle::kDistortion, Bundle::kPrincipal, Bundle::kFocal}) {
    for (size_t k = 0; k < bundle.cameras.size(); ++k) {
      Bundle::Camera& camera = bundle.cameras[k];
      const auto index = Eigen::Index(k * Bundle::kGroups + group);
      const auto n_images = Eigen::Index(bundle.images.size());
      const bool unfixed = information.has_rank ? deviation_px * information.spread[index] >
                                                      kLargestSpread * std::max(camera.width, camera.height)
                                                : information.open[n_images + index] > kLeastShare;
      if (!camera.free[group] || !unfixed) continue;
      camera.free[group] = false;
      held.push_back(std::string(kGroupNames[group]) + " of camera " + std::to_string(camera.id));
      any = true;
    }
    if (any) return true;
  }
  return false;
}

std::string Joined(const std::vector<std::string>& texts) {
  std::string joined;
  for (const std::string& text : texts) joined += (joined.empty() ? "" : ", ") + text;
  return joined;
}

// Which images an open direction moves.
std::string OpenImages(const Bundle& bundle, const ColmapModel& model, const Eigen::VectorXd& open) {
  std::vector<size_t> order(bundle.images.size());
  std::iota(order.begin(), order.end(), size_t(0));
  std::stable_sort(order.begin(), order.end(),
                   [&](size_t a, size_t b) { return open[Eigen::Index(a)] > open[Eigen::Index(b)]; });
  std::vector<std::string> names;
  double share = 0;
  for (size_t i = 0; i < order.size() && share < 0.9; ++i) {
    share += open[Eigen::Index(order[i])];
    if (i < 5)
      names.push_back(EscapePath(model.images.at(bundle.images[order[i]].id).name));
    else if (i == 5)
      names.emplace_back("…");
  }
  return "poses that the points do not fix: of " + Joined(names);
}

// In the world's units and axes, for what the observations' deviation is.
std::vector<PoseCovariance> InWorld(const Bundle& bundle, std::vector<PoseCovariance> covariances,
                                    double deviation_px) {
  for (size_t i = 0; i < covariances.size(); ++i) {
    const Bundle::Component& component = bundle.components[bundle.images[i].component];
    const double unit = component.unit / bundle.Center(component.partner).norm() * deviation_px;
    const Eigen::Matrix3d world_from_frame = unit * component.rotation.toRotationMatrix();
    covariances[i].position = world_from_frame * covariances[i].position * world_from_frame.transpose();
    covariances[i].rotation *= deviation_px * deviation_px;
  }
  return covariances;
}

// Radians that `px` are, by the longest lens.
double Angle(const Bundle& bundle, double px) {
  double focal = 0;
  for (size_t k = 0; k < bundle.cameras.size(); ++k)
    focal = std::max(focal, Lens(bundle.CameraAt(k)).focal_px().maxCoeff());
  return px / focal;
}

// Digits that the world's origin took from the frames' coordinates.
double RoundingOfWorld(const Bundle& bundle) {
  double most = 0;
  for (const Bundle::Component& component : bundle.components) {
    most = std::max(most, 64 * kEps * (1 + component.origin.norm() / component.unit));
  }
  return most;
}

// Counts what the refined model places behind its cameras or beyond their lenses. Throws InputError of a lens that is
// none.
void CountUnseen(const Bundle& bundle, BundleCertificate& certificate) {
  std::vector<double> valid_radius;
  for (size_t k = 0; k < bundle.cameras.size(); ++k) valid_radius.push_back(Lens(bundle.CameraAt(k)).ValidRadius());
  for (const Bundle::Observation& o : bundle.observations) {
    const Eigen::Vector3d in_camera = bundle.Rotation(o.image) * (bundle.Position(o.point) - bundle.Center(o.image));
    if (!(in_camera.z() > 0))
      ++certificate.n_behind_after;
    else if (!(in_camera.hnormalized().norm() < valid_radius[bundle.images[o.image].camera])) {
      ++certificate.n_beyond_lens_after;
    }
  }
}

// Why the bundle is not taken, with what was found on the way in `certificate`; empty where it is.
std::string Minimise(Bundle& bundle, const ColmapModel& model, const BundleOptions& options,
                     BundleCertificate& certificate) {
  const double scale = options.loss_scale_px;
  const auto solve = [&](double loss_scale) {
    const ceres::Solver::Summary summary = Solve(bundle, loss_scale, options);
    certificate.iterations += int(summary.iterations.size()) - 1;
    certificate.solver = ceres::LinearSolverTypeToString(summary.linear_solver_type_used);
    if (!summary.iterations.empty()) certificate.gradient_norm = summary.iterations.back().gradient_max_norm;
    certificate.converged = summary.termination_type == ceres::CONVERGENCE;
    return summary.IsSolutionUsable() ? std::string() : "Ceres found no step: " + summary.message;
  };
  // Far from the minimum most residuals are outliers to a narrow loss: a wide one first, with the lenses as they are.
  if (certificate.before.median_px > scale) {
    const std::vector<Bundle::Camera> cameras = bundle.cameras;
    for (Bundle::Camera& camera : bundle.cameras) camera.free = {false, false, false};
    if (std::string failure = solve(2 * certificate.before.median_px); !failure.empty()) return failure;
    bundle.cameras = cameras;
  }
  const bool measured = bundle.images.size() <= kMostImagesForCovariance;
  const std::vector<double> start = bundle.values;
  while (true) {
    if (std::string failure = solve(scale); !failure.empty()) return failure;
    if (!measured) break;
    const BundleInformation information = MeasureInformation(bundle, scale);
    certificate.deviation_px = DeviationPx(bundle, information.n_free);
    if (HoldUnfixed(bundle, information, certificate.deviation_px, certificate.held)) {
      bundle.values = start;
      continue;
    }
    if (!information.has_rank) {
      certificate.degeneracy = OpenImages(bundle, model, information.open);
      return *certificate.degeneracy;
    }
    const double remaining_px = std::sqrt(std::max(0.0, information.decrement));
    const double rounding_px = RoundingPx(bundle) * std::sqrt(double(2 * bundle.observations.size()));
    certificate.remaining = remaining_px / certificate.deviation_px;
    certificate.converged = remaining_px <= std::max(kConverged * certificate.deviation_px, rounding_px);
    certificate.covariances = InWorld(bundle, information.covariances, certificate.deviation_px);
    break;
  }
  if (!certificate.held.empty()) {
    certificate.structure = NamedStructure(bundle);
    certificate.degeneracy = "the images do not fix the " + Joined(certificate.held) +
                             (certificate.structure.empty() ? "" : " (" + Joined(certificate.structure) + ")") +
                             "; held as given";
  }
  return {};
}

std::string Reason(Bundle& bundle, const ColmapModel& model, const BundleOptions& options,
                   BundleCertificate& certificate) {
  const double rounding = RoundingOfWorld(bundle);
  if (auto named = NamedDegeneracy(bundle, rounding)) {
    certificate.degeneracy = named;
    return *named;
  }
  if (std::string failure = Minimise(bundle, model, options, certificate); !failure.empty()) return failure;
  const auto not_finite = [](double value) { return !std::isfinite(value); };
  if (std::any_of(bundle.values.begin(), bundle.values.end(), not_finite)) return "the minimum found is not finite";
  try {
    CountUnseen(bundle, certificate);
  } catch (const Error& error) {
    return std::string("no lens is left: ") + error.what();
  }
  certificate.after = Summarise(Errors(bundle));
  certificate.cost_after = RobustCost(bundle, options.loss_scale_px);
  const double deviation_px = std::max(certificate.deviation_px, certificate.after.median_px / kRayleighMedian);
  if (auto named = NamedDegeneracy(bundle, std::max(rounding, 3 * Angle(bundle, deviation_px)))) {
    certificate.degeneracy = named;
    certificate.covariances.clear();
    return *named;
  }
  if (!(certificate.cost_after < certificate.cost_before)) return "the cost did not fall: the model is at its minimum";
  return {};
}

}  // namespace

RefinedBundle RefineBundle(const ColmapModel& model, const BundleOptions& options) {
  const auto start = std::chrono::steady_clock::now();
  RefinedBundle refined{model, {}};
  BundleCertificate& certificate = refined.certificate;
  Bundle bundle = SelectBundle(model, certificate);
  for (Bundle::Camera& camera : bundle.cameras) {
    camera.free[Bundle::kPrincipal] &= options.principal_points;
    camera.free[Bundle::kDistortion] &= options.distortion;
  }
  if (certificate.degeneracy) {
    certificate.reason = *certificate.degeneracy;
  } else {
    certificate.before = certificate.after = Summarise(Errors(bundle));
    certificate.cost_before = certificate.cost_after = RobustCost(bundle, options.loss_scale_px);
    certificate.reason = Reason(bundle, model, options, certificate);
    if (certificate.structure.empty()) certificate.structure = NamedStructure(bundle);
    if (certificate.reason.empty()) refined.model = WithBundle(model, bundle);
  }
  certificate.accepted = certificate.reason.empty();
  certificate.seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  return refined;
}

}  // namespace nrff
