// What a bundle's observations fix and how well: the information of its images and cameras once the points are
// eliminated. Inside sfm/.
#pragma once

#include <Eigen/Core>
#include <optional>
#include <string>
#include <vector>

#include "sfm/bundle_problem.h"

namespace nrff {

struct BundleInformation {
  size_t n_free = 0;       // parameters, points included
  double decrement = 0;    // gᵀ H⁻¹ g, px²: twice what the linearised problem's cost can still fall by
  bool has_rank = true;    // every direction is fixed to more than rounding
  Eigen::VectorXd open;    // [images + cameras·kGroups] shares of the open directions; sum 1, empty with full rank
  Eigen::VectorXd spread;  // [cameras·kGroups] px of one standard deviation of 1 px, where it moves observations most;
                           // empty without full rank
  std::vector<PoseCovariance> covariances;  // of 1 px, in the order of images, frame units²; empty without full rank
};

// Gauss-Newton's information at the bundle's values, observations weighted as Cauchy's loss weighs them.
//
// Columns are scaled to unit length, points eliminated, so the rank does not depend on units: a direction counts as
// open when its eigenvalue is within the rounding of the sums it comes from, 8·d·eps for d parameters.
BundleInformation MeasureInformation(const Bundle& bundle, double loss_scale_px);

// Structure that no rank tells from a weak one, in words: rays to the points that meet at less than `angle` (no
// baseline), or points that lie within `angle` of each other in the images. Nothing where neither is so.
std::optional<std::string> NamedDegeneracy(const Bundle& bundle, double angle);

// What of every component's shape lets lenses or poses be fixed badly, in words; more than one may hold. Robust: a
// tenth of the points or images may be otherwise.
//   planar          points within a hundredth of their extent of a plane
//   forward motion  at least three cameras on a line, within a twentieth of its length, that look along it to 15°
//   no turning      at least two cameras, all turned alike to 1°: focal length and the scale along the axis are one
std::vector<std::string> NamedStructure(const Bundle& bundle);

}  // namespace nrff
