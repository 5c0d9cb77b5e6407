// Which pairs of photos are matched.
#pragma once

#include <Eigen/Core>
#include <utility>
#include <vector>

namespace nrff {

using ImagePair = std::pair<int, int>;      // first < second
using ImagePairs = std::vector<ImagePair>;  // ascending, each once

// All n (n − 1) / 2.
ImagePairs AllPairs(int n_images);

// For photos in the order of taking: each with its `n_neighbours` next ones.
ImagePairs SequentialPairs(int n_images, int n_neighbours);

// Each photo with its `n_neighbours` most similar ones, and the most similar of the pairs that keep the photos from
// falling apart into groups (a maximum spanning tree): at most n (n_neighbours + 1). `similarity`: n × n, symmetric.
ImagePairs MostSimilarPairs(const Eigen::MatrixXf& similarity, int n_neighbours);

// Each photo outside of a group with the `n_neighbours` of the group that it is most like.
ImagePairs BridgingPairs(const Eigen::MatrixXf& similarity, const std::vector<bool>& in_group, int n_neighbours);

ImagePairs Union(const ImagePairs& a, const ImagePairs& b);
ImagePairs Difference(const ImagePairs& a, const ImagePairs& b);  // those of `a` that are not in `b`

}  // namespace nrff
