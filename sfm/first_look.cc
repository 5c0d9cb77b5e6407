#include "sfm/first_look.h"

#include <algorithm>
#include <vector>

namespace nrff {
namespace {

using RowMatrix = Eigen::Matrix<float, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

constexpr Eigen::Index kWords = 64;
constexpr Eigen::Index kSamplesPerWord = 256;
constexpr int kIterations = 10;  // of k-means

// One row per feature: square roots of the descriptor's share in each direction, a unit vector.
RowMatrix RootSift(const FeatureDescriptors& descriptors) {
  RowMatrix root = descriptors.cast<float>();
  for (Eigen::Index i = 0; i < root.rows(); ++i)
    root.row(i) = (root.row(i) / std::max(root.row(i).sum(), 1.f)).cwiseSqrt();
  return root;
}

class VisualWords {
 public:
  // k-means that begins with features from all over the sample.
  explicit VisualWords(const RowMatrix& sample) : words_(std::min(kWords, sample.rows()), sample.cols()) {
    for (Eigen::Index word = 0; word < words_.rows(); ++word)
      words_.row(word) = sample.row(word * sample.rows() / words_.rows());
    for (int iteration = 0; iteration < kIterations; ++iteration) {
      const std::vector<Eigen::Index> nearest = Nearest(sample);
      RowMatrix sums = RowMatrix::Zero(words_.rows(), words_.cols());
      Eigen::VectorXf counts = Eigen::VectorXf::Zero(words_.rows());
      for (Eigen::Index i = 0; i < sample.rows(); ++i) {
        sums.row(nearest[size_t(i)]) += sample.row(i);
        counts(nearest[size_t(i)]) += 1;
      }
      for (Eigen::Index word = 0; word < words_.rows(); ++word) {
        if (counts(word) > 0) words_.row(word) = sums.row(word) / counts(word);
      }
    }
  }

  Eigen::Index n_dimensions() const { return words_.size(); }

  // A unit vector of n_dimensions, or zero.
  Eigen::VectorXf Vlad(const RowMatrix& features) const {
    RowMatrix residuals = RowMatrix::Zero(words_.rows(), words_.cols());
    const std::vector<Eigen::Index> nearest = Nearest(features);
    for (Eigen::Index i = 0; i < features.rows(); ++i)
      residuals.row(nearest[size_t(i)]) += features.row(i) - words_.row(nearest[size_t(i)]);
    for (Eigen::Index word = 0; word < residuals.rows(); ++word) residuals.row(word).normalize();
    residuals.normalize();
    return residuals.reshaped<Eigen::RowMajor>();
  }

 private:
  std::vector<Eigen::Index> Nearest(const RowMatrix& features) const {
    // |f − w|² = |f|² − 2 (f·w − |w|² / 2)
    const Eigen::RowVectorXf half_squares = words_.rowwise().squaredNorm().transpose() / 2;
    const RowMatrix closeness = (features * words_.transpose()).rowwise() - half_squares;
    std::vector<Eigen::Index> nearest(size_t(features.rows()));
    for (Eigen::Index i = 0; i < features.rows(); ++i) closeness.row(i).maxCoeff(&nearest[size_t(i)]);
    return nearest;
  }

  RowMatrix words_;
};

// Features from all over every photo, about kWords · kSamplesPerWord altogether.
RowMatrix Sample(size_t n_photos, const std::function<FeatureDescriptors(size_t)>& descriptors_of) {
  const Eigen::Index n_wanted = std::max<Eigen::Index>(1, kWords * kSamplesPerWord / Eigen::Index(n_photos));
  RowMatrix sample;
  for (size_t photo = 0; photo < n_photos; ++photo) {
    const FeatureDescriptors all = descriptors_of(photo);
    const Eigen::Index n = std::min(n_wanted, all.rows()), n_before = sample.rows();
    FeatureDescriptors chosen(n, all.cols());
    for (Eigen::Index i = 0; i < n; ++i) chosen.row(i) = all.row(i * all.rows() / n);
    sample.conservativeResize(n_before + n, all.cols());
    sample.bottomRows(n) = RootSift(chosen);
  }
  return sample;
}

}  // namespace

Eigen::MatrixXf PhotoSimilarities(size_t n_photos, const std::function<FeatureDescriptors(size_t)>& descriptors_of) {
  const VisualWords words(Sample(n_photos, descriptors_of));
  Eigen::MatrixXf vectors(words.n_dimensions(), Eigen::Index(n_photos));
  for (size_t photo = 0; photo < n_photos; ++photo)
    vectors.col(Eigen::Index(photo)) = words.Vlad(RootSift(descriptors_of(photo)));
  return vectors.transpose() * vectors;
}

}  // namespace nrff
