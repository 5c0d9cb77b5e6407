#include "sfm/image_pairs.h"

#include <algorithm>
#include <iterator>
#include <numeric>

namespace nrff {
namespace {

// Ascending also keeps a photo's features in the matcher's cache.
void SortOnce(ImagePairs& pairs) {
  std::sort(pairs.begin(), pairs.end());
  pairs.erase(std::unique(pairs.begin(), pairs.end()), pairs.end());
}

// Prim's algorithm.
ImagePairs MaximumSpanningTree(const Eigen::MatrixXf& similarity) {
  const int n = int(similarity.rows());
  ImagePairs tree;
  std::vector<int> closest(size_t(n), 0);  // of those in the tree
  std::vector<bool> in_tree(size_t(n), false);
  int added = 0;
  for (int size = 1; size < n; ++size) {
    in_tree[size_t(added)] = true;
    int next = -1;
    for (int i = 0; i < n; ++i) {
      if (in_tree[size_t(i)]) continue;
      if (similarity(i, added) > similarity(i, closest[size_t(i)])) closest[size_t(i)] = added;
      if (next < 0 || similarity(i, closest[size_t(i)]) > similarity(next, closest[size_t(next)])) next = i;
    }
    tree.emplace_back(std::minmax(next, closest[size_t(next)]));
    added = next;
  }
  return tree;
}

// Photo i with the `n` of `others`, itself left out, that it is most like; the earlier of equals.
void AddMostSimilar(const Eigen::MatrixXf& similarity, int i, std::vector<int> others, int n, ImagePairs& pairs) {
  std::erase(others, i);
  const auto end = others.begin() + std::min<std::ptrdiff_t>(n, std::ssize(others));
  std::partial_sort(others.begin(), end, others.end(),
                    [&](int a, int b) { return std::pair(-similarity(a, i), a) < std::pair(-similarity(b, i), b); });
  for (auto other = others.begin(); other != end; ++other) pairs.emplace_back(std::minmax(i, *other));
}

}  // namespace

ImagePairs AllPairs(int n_images) { return SequentialPairs(n_images, n_images); }

ImagePairs SequentialPairs(int n_images, int n_neighbours) {
  ImagePairs pairs;
  for (int i = 0; i < n_images; ++i) {
    for (int j = i + 1; j < n_images && j <= i + n_neighbours; ++j) pairs.emplace_back(i, j);
  }
  return pairs;
}

ImagePairs MostSimilarPairs(const Eigen::MatrixXf& similarity, int n_neighbours) {
  const int n = int(similarity.rows());
  ImagePairs pairs = MaximumSpanningTree(similarity);
  std::vector<int> all(static_cast<size_t>(n));
  std::iota(all.begin(), all.end(), 0);
  for (int i = 0; i < n; ++i) AddMostSimilar(similarity, i, all, n_neighbours, pairs);
  SortOnce(pairs);
  return pairs;
}

ImagePairs BridgingPairs(const Eigen::MatrixXf& similarity, const std::vector<bool>& in_group, int n_neighbours) {
  std::vector<int> group;
  for (size_t i = 0; i < in_group.size(); ++i) {
    if (in_group[i]) group.push_back(int(i));
  }
  ImagePairs pairs;
  for (size_t i = 0; i < in_group.size(); ++i) {
    if (!in_group[i]) AddMostSimilar(similarity, int(i), group, n_neighbours, pairs);
  }
  SortOnce(pairs);
  return pairs;
}

ImagePairs Union(const ImagePairs& a, const ImagePairs& b) {
  ImagePairs both;
  std::set_union(a.begin(), a.end(), b.begin(), b.end(), std::back_inserter(both));
  return both;
}

ImagePairs Difference(const ImagePairs& a, const ImagePairs& b) {
  ImagePairs rest;
  std::set_difference(a.begin(), a.end(), b.begin(), b.end(), std::back_inserter(rest));
  return rest;
}

}  // namespace nrff
