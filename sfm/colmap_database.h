// What COLMAP's database holds so far (SQLite; tables images, keypoints, descriptors, two_view_geometries). COLMAP is
// the one that writes it, but for lenses that were found.
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <filesystem>
#include <map>
#include <set>
#include <string>
#include <utility>

#include "sfm/colmap_model.h"

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

// Makes these the cameras of that id, known as if by EXIF, and forgets which matches were verified, so that COLMAP does
// that again with them. All or nothing. Throws CorruptError as above.
void SetLenses(const std::filesystem::path& file, const std::map<uint32_t, ColmapCamera>& cameras);

// Gives images, by their ids, cameras of their own, known as if by EXIF; what was verified stays so. All or nothing.
// Throws CorruptError as above.
void SetOwnCameras(const std::filesystem::path& file, const std::map<uint32_t, ColmapCamera>& by_image);

}  // namespace nrff
