// With what an attempt at a reconstruction (reconstruct.h) is made.
#pragma once

#include <cstdint>
#include <map>
#include <string>

#include "pipeline/json.h"
#include "sfm/colmap_model.h"

namespace nrff {

struct SfmSettings {
  std::string name;               // of the attempt's folder
  int max_image_size = 1000;      // px, longer side
  int max_features = 2048;        // per photo
  int first_octave = 0;           // −1: features are searched in the photo doubled in size, too
  double peak_threshold = 0;      // of features' contrast; 0: COLMAP's default, lower where that gives few
  bool exhaustive = false;        // all pairs
  int n_neighbours = 10;          // otherwise: each photo with this many most similar ones (first_look.h)
  int n_next = 3;                 // and, in a capture in the order of taking, with this many next ones
  int n_nearest = 0;              // and with this many nearest ones by GPS
  bool tolerant_mapping = false;  // place photos by fewer matches and smaller parallax
  CameraModel camera_model = CameraModel::kSimpleRadial;  // of lenses that are not known
  std::map<int, ColmapCamera> lenses;                     // known ones, by group; of any size of the photos
  uint64_t seed = 0;
  int n_threads = 1;
};

Json ToJson(const SfmSettings& settings);  // without matching, seed and threads
// Throws CorruptError beginning with `where`.
SfmSettings SfmSettingsFromJson(const Json& json, const std::string& where);

}  // namespace nrff
