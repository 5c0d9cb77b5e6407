// How near photos were taken to each other, by the positions in their EXIF data.
#pragma once

#include <Eigen/Core>
#include <vector>

#include "sfm/capture.h"

namespace nrff {

// Of all photos; empty where one does not say where it was taken.
std::vector<GpsPosition> GpsPositions(const Capture& capture);

// Centres in metres, one column each: east, north and up of their mean on the WGS 84 ellipsoid's tangent plane, good to
// 1 % for captures of less than some 50 km. Up is 0 for all where some position has no altitude.
Eigen::Matrix3Xd LocalPositions(const std::vector<GpsPosition>& positions);

// Root mean square distance of positions from their mean, m.
double Spread_m(const Eigen::Matrix3Xd& positions);

// n × n: −distance in m, for MostSimilarPairs (image_pairs.h).
Eigen::MatrixXf Nearness(const Eigen::Matrix3Xd& positions);

}  // namespace nrff
