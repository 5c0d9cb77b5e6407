// Bundle refinement: poses, intrinsics with distortion, and points of a COLMAP model, together, so that the points are
// seen where they were observed [Triggs00].
//
// Minimises Σ ρ(|projection − observation|²) by Levenberg-Marquardt (Ceres) with ρ = Cauchy's, in double. What is left
// open by the data is not solved for but said: a model that does not fix its own structure comes back as it was, with
// the reason. Intrinsics are shared by the images of a camera; those of a camera's focal length, principal point and
// distortion that its images do not fix are held, and the principal point of cameras of fewer than five images.
//
// Gauge. Each connected component of images keeps the pose of its anchor, the image with the most observations, and the
// distance from there to its partner, the image farthest from it: a well-measured frame and a long baseline keep the
// other images' covariances small, and no prior has to be invented.
#pragma once

#include <Eigen/Core>
#include <cmath>
#include <cstdint>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/json.h"
#include "pipeline/manifest.h"
#include "sfm/colmap_model.h"

namespace nrff {

struct BundleOptions {
  double loss_scale_px = 2;  // residuals beyond count less and less: about four times those of well-placed points
  int max_iterations = 200;
  double least_gain = 1e-6;  // a step that lowers the cost by less is the last; in the mean cost of an observation
  bool principal_points = true, distortion = true;  // false: held as given
  int n_threads = 1;                                // one: the same bits every time
};

// Where an image's pose may lie, one standard deviation of the observations taken from their own residuals. Relative to
// the gauge: the anchor's own are zero.
struct PoseCovariance {
  uint32_t image = 0;
  Eigen::Matrix3d position = Eigen::Matrix3d::Zero();  // of the centre, world units²
  Eigen::Matrix3d rotation = Eigen::Matrix3d::Zero();  // of a small turn about the camera's axes, radians²

  double PositionDeviation() const { return std::sqrt(position.trace()); }  // world units
  double RotationDeviation() const { return std::sqrt(rotation.trace()); }  // radians
};

struct BundleComponent {
  uint32_t anchor = 0, partner = 0;
  std::vector<uint32_t> images;
  size_t n_points = 0;
};

struct ReprojectionErrors {
  double median_px = 0, mean_px = 0;
};

// What was done and how far it can be relied upon.
struct BundleCertificate {
  bool accepted = false;
  std::string reason;  // why not accepted; empty if it was

  size_t n_observations = 0, n_points = 0;   // refined
  size_t n_behind = 0;                       // observations left out: of points behind their camera,
  size_t n_beyond_lens = 0;                  // past the radius up to which the lens model is one-to-one
  std::vector<uint64_t> points_left_out;     // seen by fewer than two images
  std::vector<std::string> images_left_out;  // with fewer than three points, or in a component of its own
  std::vector<size_t> track_lengths;         // [n]: refined points with n observations
  std::vector<BundleComponent> components;
  size_t n_principal_held = 0;    // cameras of so few images that their principal point is held anyway
  std::vector<std::string> held;  // intrinsics that the data do not fix: "focal length of camera 1"

  ReprojectionErrors before, after;
  double cost_before = 0, cost_after = 0;  // ½ Σ ρ, px²
  size_t n_behind_after = 0, n_beyond_lens_after = 0;
  int iterations = 0;
  bool converged = false;
  double gradient_norm = 0;         // largest component, in Ceres's parameters
  std::optional<double> remaining;  // standard deviations between here and the minimum of the linearised problem
  double seconds = 0;
  std::string solver;                     // Ceres's name of the linear solver
  std::optional<std::string> degeneracy;  // what the data leave open, in words
  std::vector<std::string> structure;     // shapes that fix lenses or poses badly, whether or not they do here: planar,
                                          // forward motion, no turning (bundle_information.h)

  double deviation_px = 0;                  // of an observation's coordinate, from the median residual
  std::vector<PoseCovariance> covariances;  // by image id; empty beyond kMostImagesForCovariance and where refused
};

// The reduced camera matrix is dense: 3000², 72 MB.
inline constexpr size_t kMostImagesForCovariance = 500;

struct RefinedBundle {
  ColmapModel model;  // the input's where not accepted
  BundleCertificate certificate;
};

// `error_px` of refined points becomes the mean of their reprojection errors. Throws InputError naming the image, point
// or camera that is not finite, or a track's element that is not there.
RefinedBundle RefineBundle(const ColmapModel& model, const BundleOptions& options);

// Schema 1 of refinement.json; names images as `model` does.
Json CertificateJson(const BundleCertificate& certificate, const ColmapModel& model);

inline constexpr char kRefinementName[] = "refinement.json";

// Where the model of `dir` is: an artifact's or COLMAP's sparse/, or itself.
std::filesystem::path FolderOfModel(const std::filesystem::path& dir);

// `nrff-pose refine`: reads the model in `dir`, writes sparse/*.bin and refinement.json. The latter holds times and is
// no part of the content hash.
void RefineModel(const std::filesystem::path& dir, const BundleOptions& options, ArtifactWriter& artifact);

}  // namespace nrff
