// NSVF's layout, which the Tanks & Temples objects and NSVF's own synthetic scenes come in.
//
//   intrinsics.txt  16 numbers: 4×4 K; 9: 3×3 K; 11: f cx cy 0, a 3-vector, near, scale, height width; 3 or 4: f cx cy
//   pose/NAME.txt   camera-to-world 4×4, OpenCV axes
//   rgb/NAME.png    (or images/); a prefix 0_ is train, 1_ validation, 2_ test; where there is no 2_, 1_ is test
//   bbox.txt        min xyz, max xyz, voxel size; taken ×1.2 about its centre, as the reference code's loader does
// The background is white.
#pragma once

#include <filesystem>
#include <optional>

#include "sfm/source.h"

namespace nrff {

// Nothing unless `root` holds intrinsics.txt and pose/. Throws InputError naming the file that cannot be used.
std::optional<Source> ReadNsvfSource(const std::filesystem::path& root);

}  // namespace nrff
