#include "sfm/image_pairs.h"

#include <algorithm>

namespace nrff {

std::vector<ImagePair> AllPairs(int n_images) { return SequentialPairs(n_images, n_images); }

std::vector<ImagePair> SequentialPairs(int n_images, int n_neighbours) {
  std::vector<ImagePair> pairs;
  for (int distance = 1; distance < n_images;
       distance = distance < n_neighbours ? distance + 1 : std::max(distance + 1, distance * 4 / 3)) {
    for (int i = 0; i + distance < n_images; ++i) pairs.emplace_back(i, i + distance);
  }
  std::sort(pairs.begin(), pairs.end());  // neighbours share the matcher's cache
  return pairs;
}

}  // namespace nrff
