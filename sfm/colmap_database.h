// What COLMAP's database holds so far (SQLite; tables images, keypoints, two_view_geometries). Read only: COLMAP is the
// one that writes it.
#pragma once

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

}  // namespace nrff
