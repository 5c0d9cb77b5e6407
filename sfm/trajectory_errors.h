// How far an estimated camera trajectory is from the true one.
//
// Estimated poses are known up to a similarity of the world, so the two are aligned first: by least median of squares
// over similarities of three centres [Umeyama91] and of the mean rotation, then by Ceres on all centres with a Cauchy
// loss, whose scale is the residuals' own median, so that images that SfM placed wrongly do not pull the others along.
// Relative poses of two images need no alignment.
#pragma once

#include <Eigen/Core>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include "pipeline/json.h"
#include "sfm/crop_volume.h"
#include "sfm/trajectory.h"

namespace nrff {

// Indices of poses of the same photo: by name, else by file name, else, where none is the same and there are as many
// of each, in order.
struct Matches {
  std::vector<std::pair<size_t, size_t>> pairs;  // estimated, true
  std::string by;                                // "name", "file name", "order"
};
Matches MatchPoses(const Trajectory& estimated, const Trajectory& truth);

// truth_from_estimated, a 4×4 similarity. Throws InputError with fewer than two matches or where all true, or all
// estimated, centres are one point. Centres that lie on a line but for noise leave a rotation about it open: the
// cameras' own then decide.
Eigen::Matrix4d AlignTrajectories(const Trajectory& estimated, const Trajectory& truth, const Matches& matches);

// Share of errors below a threshold, averaged over all thresholds up to `threshold`: the area under the recall curve.
double AreaUnderRecall(const std::vector<double>& errors, double threshold);

// {n_true, n_estimated, n_matched, matched_by, radius: rms distance of the true centres from their mean, true units
//  position {median, mean, rms, max: of the radius; auc {"1%": …}}     after alignment
//  rotation_deg {median, mean, rms, max; auc {"1": …}}                  after alignment
//  relative_deg {rotation {median, …}, direction {median, …}, auc {"1": …}}   of every two images; an error is the
//    greater of the rotation's and the baseline direction's
//  object_deg {median, mean, rms, max}, with `object` alone           after alignment: between where the estimated and
//    the true camera see a corner of the object
//  truth_from_estimated [16]}
// Areas count true images that were not estimated as errors without bound; medians are of those that were.
// `object`: of the true world.
Json TrajectoryErrors(const Trajectory& estimated, const Trajectory& truth, const CropVolume* object = nullptr);

// The same in a few lines.
std::string TrajectoryErrorsText(const Json& errors);

}  // namespace nrff
