// Which camera model the photos of a reconstruction need: the simplest that predicts observations which it was not
// fitted to.
//
// For each candidate the model is refined (bundle_refinement.h) without one observation of every track of four and
// more; how far these are from where the refined model has them is what the candidate is judged by.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "pipeline/needs.h"
#include "sfm/bundle_refinement.h"
#include "sfm/colmap_model.h"

namespace nrff {

struct LensTrial {
  CameraModel model = CameraModel::kSimpleRadial;
  double error_px = 0;  // mean over the held-out observations, no one counting more than kMostHeldOut_px
};

struct LensChoice {
  std::vector<LensTrial> trials;     // the model's own first; empty where there is too little to judge by
  std::optional<Decision> decision;  // needs::RicherLens of these
  CameraModel chosen = CameraModel::kSimpleRadial;
  bool zoomed = false;  // the simple model is chosen since focal lengths of the images' own do better than a richer one
};

inline constexpr double kMostHeldOut_px = 4;   // twice what counts as an inlier while mapping
inline constexpr size_t kFewestForLens = 5;    // images of a camera, below which its lens stays as it is
inline constexpr size_t kFewestHeldOut = 100;  // the same for all candidates: differences of 3 % show
// Degrees between corners from which a fisheye is tried: below, its four coefficients take whatever is left over (fox's
// telephone, 60°, came to 0.4, 0.2, −0.7, 0.9, with which mapping fell apart), and perspective models have all there
// is. A fisheye of 160° that was mapped with a simple lens seems to have 83°.
inline constexpr double kWide_deg = 75;

// `model`: of the working photos, all cameras SIMPLE_RADIAL. Tried are RADIAL, OPENCV and OPENCV_FISHEYE, and, where
// one of these seems better, whether a focal length for each image is (unless `own_focal_lengths` says that it may not
// be).
LensChoice ChooseLens(const ColmapModel& model, bool own_focal_lengths, int n_threads);

// The camera with `model`'s parameters for what its own lens does to rays up to its corners; exact where `model`
// includes it, else (fisheyes) the least squares fit.
ColmapCamera WithCameraModel(const ColmapCamera& camera, CameraModel model);

// `model` with every camera of kFewestForLens images and more so.
ColmapModel WithLenses(ColmapModel model, CameraModel camera_model);

// Photos share a camera where nothing says otherwise, but a lens that was zoomed, or breathed as it focused, does not.
// As for LensTrial, with shared cameras and with a focal length for each image; none where there is too little to judge
// by, or no camera is shared.
std::optional<needs::FocalLengthErrors> TryOwnFocalLengths(const ColmapModel& model, int n_threads);

// `model` refined so that every image has a camera of its own, by the image's id, whose focal lengths alone are its
// own: principal points are as given, distortions as refined with shared cameras. A refinement that was not accepted
// comes with the model as it was, cameras shared.
RefinedBundle WithOwnFocalLengths(const ColmapModel& model, int n_threads);
// The same of a model whose images were mapped with cameras of their own: those that share one in `shared` have its
// principal point and the medians of their distortions.
RefinedBundle WithOwnFocalLengths(ColmapModel mapped, const ColmapModel& shared, int n_threads);
inline BundleOptions OwnFocalLengthsAlone(int n_threads) {
  return {.principal_points = false, .distortion = false, .n_threads = n_threads};
}

// The angle between the rays through opposite corners, degrees; 2·88.9° at the most (Lens::kLargestRadius).
double FieldOfView_deg(const ColmapCamera& camera);

}  // namespace nrff
