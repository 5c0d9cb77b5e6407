// A first look at a capture: how alike its photos are, at a small part of the cost of matching any two of them.
//
// A photo is described by one vector, VLAD [Jégou et al. 2010]: the sum of its features' residuals to their nearest of
// kWords visual words, normalised word by word [Arandjelović and Zisserman 2013]. Descriptors are square-rooted first
// (RootSIFT); the words are k-means of the capture's own descriptors. The similarity of two photos is the cosine of
// their vectors. Work grows linearly with the number of photos, but for n² / 2 scalar products.
#pragma once

#include <Eigen/Core>
#include <cstddef>
#include <functional>

#include "sfm/colmap_database.h"

namespace nrff {

// `descriptors_of(i)`: those of photo i, the same number of columns for all; called twice for every photo. Returns
// n_photos × n_photos, symmetric, in [−1, 1]; a photo without features is like no other: 0.
Eigen::MatrixXf PhotoSimilarities(size_t n_photos, const std::function<FeatureDescriptors(size_t)>& descriptors_of);

}  // namespace nrff
