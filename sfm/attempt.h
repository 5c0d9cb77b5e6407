// What one attempt at a reconstruction (reconstruct.h) came to.
#pragma once

#include <cstddef>
#include <filesystem>
#include <optional>
#include <vector>

#include "sfm/colmap_database.h"
#include "sfm/colmap_model.h"
#include "sfm/sfm_settings.h"

namespace nrff {

struct Attempt {
  SfmSettings settings;              // as they came to be
  std::vector<ColmapModel> models;   // of the working photos; may be none
  std::optional<ColmapModel> grown;  // the earlier model with the added photos, where there was one
  ColmapDatabase database;           // after matching
  std::filesystem::path database_file;
  size_t n_pairs = 0;
  double seconds_features = 0, seconds_matching = 0, seconds_mapping = 0;
};

// By photos, then points; nullptr where there is none.
const ColmapModel* LargestModel(const std::vector<ColmapModel>& models);

// What the attempt came to: the earlier model grown by the added photos, unless mapping from scratch placed more;
// nullptr and 0 photos where there is none.
const ColmapModel* BestModel(const Attempt& attempt);
size_t NumRegistered(const Attempt& attempt);

}  // namespace nrff
