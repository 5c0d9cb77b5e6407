#include "sfm/image_pairs.h"

#include <algorithm>
#include <iterator>
#include <limits>
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
  std::vector<int> others(static_cast<size_t>(n));
  for (int i = 0; i < n; ++i) {
    std::iota(others.begin(), others.end(), 0);
    others.erase(others.begin() + i);
    const auto end = others.begin() + std::min(n_neighbours, n - 1);
    std::partial_sort(others.begin(), end, others.end(),
                      [&](int a, int b) { return std::pair(-similarity(a, i), a) < std::pair(-similarity(b, i), b); });
    for (auto other = others.begin(); other != end; ++other) pairs.emplace_back(std::minmax(i, *other));
    others.resize(size_t(n));
  }
  SortOnce(pairs);
  return pairs;
}

ImagePairs Union(const ImagePairs& a, const ImagePairs& b) {
  ImagePairs both;
  std::set_union(a.begin(), a.end(), b.begin(), b.end(), std::back_inserter(both));
  return both;
}

}  // namespace nrff
