// What COLMAP's database holds so far (SQLite; tables images, keypoints, descriptors, two_view_geometries). Read only:
// COLMAP is the one that writes it.
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <filesystem>
#include <map>
#include <set>
#include <string>
#include <utility>

namespace nrff {

struct ColmapDatabase {
  struct Image {
    std::string name;
    uint32_t camera_id = 0;
    int n_keypoints = -1;  // −1: not extracted yet
  };
  std::map<uint32_t, Image> images;                               // by COLMAP's image id
  std::map<std::pair<uint32_t, uint32_t>, int> verified_matches;  // pairs matched so far, smaller id first → inliers
};

// An absent file is an empty database. Throws CorruptError naming the file when it cannot be read.
ColmapDatabase ReadColmapDatabase(const std::filesystem::path& file);

// One row per feature: SIFT's 128 bytes.
using FeatureDescriptors = Eigen::Matrix<uint8_t, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

// The descriptors of an image's features; none where it has not been extracted. Throws CorruptError as above.
FeatureDescriptors ReadFeatureDescriptors(const std::filesystem::path& file, uint32_t image_id);

}  // namespace nrff
