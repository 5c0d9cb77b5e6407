// Which pairs of photos are matched.
#pragma once

#include <utility>
#include <vector>

namespace nrff {

using ImagePair = std::pair<int, int>;  // first < second

// All n (n − 1) / 2.
std::vector<ImagePair> AllPairs(int n_images);

// For photos in the order of taking: each with its `n_neighbours` next ones, and with those further on at distances
// that grow by about 4/3, so that a camera that comes back meets its earlier photos (O(n log n) pairs; no vocabulary
// tree).
std::vector<ImagePair> SequentialPairs(int n_images, int n_neighbours);

}  // namespace nrff
