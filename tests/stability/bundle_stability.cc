// Bundle refinement in double: any world, outliers, points in camera centres, rays that hardly meet, open structure.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <string>

#include "sfm/bundle_problem.h"
#include "sfm/bundle_refinement.h"
#include "tests/bundle_fixture.h"
#include "tests/stability/table.h"

namespace nrff::stability {
namespace {

using Eigen::Quaterniond;
using Eigen::Vector3d;

constexpr double kU = kUnit<double>;
const ColmapCamera kCamera{1, CameraModel::kRadial, 640, 480, {400, 318, 243, -0.1, 0.02}};

// By how much the centres of `certificate`'s images can move when its residuals do by `norm_px` in all: a displacement
// is at most a standard deviation per pixel of length, |H⁻¹ Jᵀ δ| ≤ √(H⁻¹)ᵢᵢ |δ|. World units.
double Displacement(const BundleCertificate& certificate, double norm_px) {
  double most = 0;
  for (const PoseCovariance& pose : certificate.covariances) {
    most = std::max(most, pose.PositionDeviation() / certificate.deviation_px);
  }
  return most * norm_px;
}

// Length of what rounding leaves in all residuals: each is a sum of terms as large as the image, through a rotation, a
// division and the lens.
double RoundingNorm(const BundleCertificate& certificate) {
  return 64 * kU * kCamera.width * std::sqrt(2 * double(certificate.n_observations));
}

double Radius(const ColmapModel& model) {
  double most = 0;
  for (const auto& [id, image] : model.images) {
    most = std::max(most, (image.Center() - model.images.begin()->second.Center()).norm());
  }
  return most;
}

// The similarity changes the start by its own rounding alone, which the minimum does not know of; centres 1e7 from the
// origin are then written in what digits are left.
TEST(BundleRefinement, FindsTheSameMinimumWhateverTheWorld) {
  const ColmapModel truth = Ring(kCamera), start = Perturbed(truth, 0.003);
  const auto [expected, certificate] = RefineBundle(start, {});
  const double bound = Displacement(certificate, RoundingNorm(certificate)) / Radius(truth);
  Hold("bundle", "centres against the true ones, of their extent", "as given", Compare(expected, truth).position,
       bound);
  const Quaterniond turn = Quaterniond(0.9, 0.1, -0.3, 0.2).normalized();
  for (const auto& [condition, scale, offset] :
       {std::tuple("scale 1e-6", 1e-6, 0.0), {"scale 1e6", 1e6, 0.0}, {"1e7 from the origin", 1.0, 1e7}}) {
    const ColmapModel moved = RefineBundle(Moved(start, scale, turn, Vector3d::Constant(offset)), {}).model;
    Hold("bundle", "centres against those in another world, of their extent", condition,
         Compare(moved, expected).position, 2 * bound + 16 * kU * std::sqrt(3) * offset / scale);
  }
}

// Cauchy's loss pulls with c/2 at the most, wherever an observation lies.
TEST(BundleRefinement, OutliersPullWithNoMoreThanTheLossAllows) {
  const ColmapModel truth = Ring(kCamera, 16, 300);
  ColmapModel start = Perturbed(truth, 0.001);
  std::mt19937 random(2);
  std::uniform_real_distribution<double> x(0, kCamera.width), y(0, kCamera.height);
  size_t n_outliers = 0;
  for (auto& [id, image] : start.images) {
    for (ColmapObservation& observation : image.observations) {
      if (random() % 5 != 0) continue;
      observation = {x(random), y(random), observation.point_id};
      ++n_outliers;
    }
  }
  const BundleOptions options;
  const auto [model, certificate] = RefineBundle(start, options);
  const double pull = options.loss_scale_px / 2 * std::sqrt(double(n_outliers));
  Hold("bundle", "centres against the true ones, of their extent", "20 % outliers", Compare(model, truth).position,
       Displacement(certificate, pull) / Radius(truth));
}

TEST(BundleRefinement, ResidualsAreFiniteWhereverThePointIs) {
  int n_not_finite = 0;
  const double rotation[] = {0, 0, 0, 1}, center[] = {0, 0, 0};
  for (const ColmapCamera& camera : CamerasOfAllModels()) {
    const auto cost = ReprojectionCost(camera.model, {100, 200});
    for (const double z : {0.0, 5e-324, 1e-300, 1e-13, 1e-11, -1e-12, -1.0, 1e300}) {
      for (const double x : {0.0, 5e-324, 1e-12, 1.0, -1e300}) {
        const double point[] = {x, -x, z};
        double residual[2], by_rotation[8], by_center[6], by_point[6], by_intrinsics[24] = {};
        const double* values[] = {rotation, center, point, camera.params.data()};
        double* jacobians[] = {by_rotation, by_center, by_point, by_intrinsics};
        cost->Evaluate(values, residual, jacobians);
        const auto count = [&](const auto& numbers) {
          n_not_finite +=
              int(std::count_if(std::begin(numbers), std::end(numbers), [](double v) { return !std::isfinite(v); }));
        };
        count(residual), count(by_rotation), count(by_center), count(by_point), count(by_intrinsics);
      }
    }
  }
  Hold("bundle", "residuals and derivatives that are not finite", "points at and behind the centre", n_not_finite, 0);
}

// Points that start a hair in front of a camera, with derivatives of 1e9 px and more, on their way to where they are.
TEST(BundleRefinement, PointsThatStartInACameraDoNotSpoilTheOthers) {
  const ColmapModel truth = Ring(kCamera);
  ColmapModel start = Perturbed(truth, 0.003);
  for (const uint64_t id : {3, 50, 101}) {
    const ColmapImage& image = start.images.at(start.points[id].track.front().first);
    start.points[id].position = image.Center() + 1e-6 * (image.rotation.conjugate() * Vector3d(0.1, 0.1, 1));
  }
  auto [model, certificate] = RefineBundle(start, {});
  ColmapModel others = truth;
  for (const uint64_t id : {3, 50, 101}) others.points.erase(id);
  const double n_outliers = 3 * double(truth.images.size());
  Hold("bundle", "centres against the true ones, of their extent", "points that start in a camera",
       Compare(model, others).position,
       Displacement(certificate,
                    RoundingNorm(certificate) + BundleOptions().loss_scale_px / 2 * std::sqrt(2 * n_outliers)) /
           Radius(truth));
}

// Points so far that their rays are parallel but for the last digits: no depth, but directions like others'. Below 1e-6
// their depths are damped to where they started, at seven tenths; a pixel feels f·b·(1/0.7 − 1)/d of that over a
// baseline b of 8.
TEST(BundleRefinement, RaysThatHardlyMeetDoNotSpoilTheOthers) {
  for (const auto& [condition, distance] :
       {std::pair("rays parallel to 1e-6", 4e6), {"rays parallel to 1e-9", 4e9}, {"rays parallel to 1e-12", 4e12}}) {
    ColmapModel truth = Ring(kCamera);
    const ColmapModel near = truth;
    std::vector<Vector3d> far = PointsInBall(40, 1, 3);
    for (Vector3d& point : far) point *= distance / point.norm();
    AddPoints(truth, far);
    Observe(truth);
    ColmapModel start = Perturbed(truth, 0.002);
    for (auto& [id, point] : start.points) {
      if (id > near.points.size()) point.position = 0.7 * truth.points[id].position;
    }
    const auto [model, certificate] = RefineBundle(start, {});
    const double n_observations = double(certificate.n_observations);
    const double damped_px = distance > 1e7 ? 400 * 8 * (1 / 0.7 - 1) / distance : 0;
    const double norm_px = RoundingNorm(certificate) + damped_px * std::sqrt(n_observations);
    Hold("bundle", "centres against the true ones, of their extent", condition, Compare(model, near).position,
         certificate.accepted ? Displacement(certificate, norm_px) / Radius(truth) : -1);
    Hold("bundle", "mean reprojection error, px", condition, certificate.after.mean_px,
         norm_px / std::sqrt(n_observations));
  }
}

TEST(BundleRefinement, OpenStructureIsNamed) {
  const auto hold = [](const char* condition, const ColmapModel& model) {
    Hold("bundle", "open structure that is not named", condition,
         RefineBundle(model, {}).certificate.degeneracy ? 0 : 1, 0);
  };
  for (const auto& [condition, offset] :
       {std::pair("rotation only", 0.0), {"rotation only, 1e7 from the origin", 1e7}}) {
    ColmapModel model;
    model.cameras[1] = kCamera;
    for (int i = 0; i < 8; ++i) {
      AddImage(model, 1, LookingAt(Vector3d::Zero(), {4, 0.3 * i, 0.1 * i}, 0.2 * i), Vector3d::Zero());
    }
    AddPoints(model, PointsInBall(300, 20, 4));
    Observe(model);
    hold(condition, Moved(model, 1, Quaterniond(0.9, 0.1, -0.3, 0.2).normalized(), Vector3d::Constant(offset)));
  }
  ColmapModel one_place = Ring(kCamera);
  for (auto& [id, point] : one_place.points) point.position = {0.1, 0.2, 0.3};
  Observe(one_place);
  hold("points at one place", one_place);
  hold("one image", Ring(kCamera, 1));
  ColmapModel halves = Ring(kCamera);
  halves.points[10].position = Vector3d::Zero();
  Observe(halves);
  for (auto& [id, point] : halves.points) {
    std::erase_if(point.track,
                  [shared = id == 10, half = id % 2](const auto& e) { return !shared && e.first % 2 != half; });
  }
  hold("halves that share one point", halves);
  ColmapModel square;
  square.cameras[1] = {1, CameraModel::kSimplePinhole, 640, 480, {400, 320, 240}};
  for (int i = 0; i < 9; ++i) {
    const int column = i % 3, row = i / 3;
    AddImage(square, 1, Eigen::Matrix3d(Eigen::AngleAxisd(0.1 * i, Vector3d::UnitZ())),
             {0.7 * column, 0.6 * row, -4 + 0.2 * i});
  }
  std::vector<Vector3d> points = PointsInBall(150, 2, 4);
  for (Vector3d& point : points) point.z() = 0;
  AddPoints(square, points);
  Observe(square);
  hold("a plane seen square, focal length free", square);
}

}  // namespace
}  // namespace nrff::stability
