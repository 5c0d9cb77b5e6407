#include "sfm/sfm_diagnosis.h"

#include <algorithm>
#include <map>
#include <set>
#include <vector>

#include "sfm/working_photos.h"

namespace nrff {
namespace {

constexpr int kFewMatches = 50;     // with any other photo: too little overlap
constexpr int kFewKeypoints = 200;  // blurred, or nothing but smooth surfaces
constexpr size_t kNamed = 5;

int Median(std::vector<int> values) {
  const auto middle = values.begin() + std::ptrdiff_t(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

}  // namespace

std::string DiagnoseRegistration(const Capture& capture, const ColmapDatabase& database, const ColmapModel* model) {
  std::map<std::string, int> n_keypoints, most_matches;  // by photo id
  std::map<uint32_t, std::string> ids;
  for (const auto& [id, image] : database.images) {
    ids[id] = IdOfWorkingPhoto(image.name);
    n_keypoints[ids[id]] = image.n_keypoints;
  }
  for (const auto& [pair, n] : database.verified_matches) {
    for (const uint32_t id : {pair.first, pair.second}) most_matches[ids[id]] = std::max(most_matches[ids[id]], n);
  }
  std::set<std::string> placed;
  if (model) {
    for (const auto& [id, image] : model->images) placed.insert(IdOfWorkingPhoto(image.name));
  }
  std::vector<int> matches, keypoints;
  std::string named;
  size_t n_unplaced = 0;
  for (const CaptureImage& photo : capture.images) {
    matches.push_back(most_matches[photo.id]);
    keypoints.push_back(n_keypoints[photo.id]);
    if (placed.count(photo.id)) continue;
    if (++n_unplaced <= kNamed)
      named += (named.empty() ? "" : ", ") + photo.Name() + " (" + std::to_string(matches.back()) + ")";
  }
  if (n_unplaced > kNamed) named += ", …";

  std::string cause;
  if (Median(keypoints) < kFewKeypoints) {
    cause = "the photos show too little texture or are blurred (about " + std::to_string(Median(keypoints)) +
            " features a photo): take sharper photos, in better light, of something that is not smooth";
  } else if (Median(matches) < kFewMatches) {
    const bool has_frames =
        std::any_of(capture.images.begin(), capture.images.end(), [](const auto& photo) { return photo.extracted; });
    cause = std::string("the photos overlap too little: ") +
            (has_frames ? "take more frames of the video with --frames" : "add photos in between") +
            ", so that neighbours share two thirds of what they show";
  } else {
    cause =
        "the photos match, but not as views of one rigid scene from different places: move the camera between photos"
        " (turning it is not enough, nor are copies of one photo) and keep the scene still";
  }
  return "only " + std::to_string(placed.size()) + " of " + std::to_string(capture.images.size()) +
         " photos could be placed; not placed, with their most matches to any other photo: " + named + "; " + cause;
}

}  // namespace nrff
