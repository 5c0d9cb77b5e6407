// Which photos are alike at a first look, and the pairs chosen by it.
#include "sfm/first_look.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sqlite3.h>

#include <algorithm>
#include <numeric>
#include <random>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "sfm/gps.h"
#include "sfm/image_pairs.h"
#include "tests/temporary_directory.h"

namespace nrff {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;

constexpr int kPointsSeen = 300, kPointsApart = 30;  // neighbours share nine tenths

// A camera that goes round a ring of points: photo i sees kPointsSeen of them, each with a little noise.
std::vector<FeatureDescriptors> RingOfPhotos(int n_photos) {
  std::mt19937 random(5);
  std::uniform_int_distribution<int> value(0, 120), noise(-6, 6);
  FeatureDescriptors points(n_photos * kPointsApart, 128);
  for (Eigen::Index i = 0; i < points.size(); ++i) points.data()[i] = uint8_t(value(random));
  std::vector<FeatureDescriptors> photos;
  for (int i = 0; i < n_photos; ++i) {
    FeatureDescriptors seen(kPointsSeen, 128);
    for (int k = 0; k < kPointsSeen; ++k) {
      const Eigen::Index point = (i * kPointsApart + k) % points.rows();
      for (int d = 0; d < 128; ++d) seen(k, d) = uint8_t(std::clamp(points(point, d) + noise(random), 0, 255));
    }
    photos.push_back(seen);
  }
  return photos;
}

Eigen::MatrixXf Similarities(const std::vector<FeatureDescriptors>& photos) {
  return PhotoSimilarities(photos.size(), [&](size_t i) { return photos[i]; });
}

Eigen::MatrixXf RandomSimilarities(int n) {
  std::srand(3);
  const Eigen::MatrixXf random = Eigen::MatrixXf::Random(n, n);
  return random + random.transpose();
}

bool Contains(const ImagePairs& pairs, int a, int b) {
  return std::binary_search(pairs.begin(), pairs.end(), ImagePair(std::minmax(a, b)));
}

int NumGroups(const ImagePairs& pairs, int n_images) {
  std::vector<int> group(static_cast<size_t>(n_images));
  std::iota(group.begin(), group.end(), 0);
  int n_groups = n_images;
  for (const auto& [a, b] : pairs) {
    const int from = group[size_t(b)], to = group[size_t(a)];
    n_groups -= from != to;
    std::replace(group.begin(), group.end(), from, to);
  }
  return n_groups;
}

TEST(FirstLook, PhotosAreAsAlikeAsTheyShareFeatures) {
  constexpr int kPhotos = 40;
  const Eigen::MatrixXf similarity = Similarities(RingOfPhotos(kPhotos));
  for (int i = 0; i < kPhotos; ++i) {
    EXPECT_NEAR(similarity(i, i), 1, 1e-5);
    for (const int distance : {1, 2, 3, 4}) {
      EXPECT_GT(similarity(i, (i + distance) % kPhotos), similarity(i, (i + distance + 2) % kPhotos)) << i;
    }
  }
  EXPECT_LE(similarity.maxCoeff(), 1 + 1e-5);
  EXPECT_EQ(similarity, similarity.transpose());
}

TEST(FirstLook, PairsAreTheSamePhotosInWhateverOrderTheyCome) {
  const std::vector<FeatureDescriptors> photos = RingOfPhotos(40);
  std::vector<int> order(photos.size());
  std::iota(order.begin(), order.end(), 0);
  std::shuffle(order.begin(), order.end(), std::mt19937(8));
  std::vector<FeatureDescriptors> shuffled;
  for (const int i : order) shuffled.push_back(photos[size_t(i)]);
  const ImagePairs pairs = MostSimilarPairs(Similarities(shuffled), 4);
  for (size_t i = 0; i < order.size(); ++i) {
    for (size_t j = 0; j < i; ++j) {
      const int apart = std::abs(order[i] - order[j]), distance = std::min(apart, 40 - apart);
      EXPECT_EQ(Contains(pairs, int(i), int(j)), distance <= 2) << order[i] << " " << order[j];
    }
  }
}

TEST(FirstLook, APhotoWithoutFeaturesIsLikeNoOther) {
  std::vector<FeatureDescriptors> photos = RingOfPhotos(12);
  photos[3] = FeatureDescriptors(0, 128);
  photos[0] = FeatureDescriptors(0, 128);
  photos[7].setZero();
  const Eigen::MatrixXf similarity = Similarities(photos);
  EXPECT_TRUE(similarity.allFinite());
  EXPECT_EQ(similarity.col(3).cwiseAbs().maxCoeff(), 0);
  EXPECT_GT(similarity(1, 2), 0);
  const std::vector<FeatureDescriptors> blank(5, FeatureDescriptors(0, 128));
  EXPECT_EQ(Similarities(blank), Eigen::MatrixXf::Zero(5, 5));
}

TEST(ImagePairs, EachPhotoIsPairedWithItsMostSimilarOnesAndPairsGrowLinearly) {
  constexpr int kNeighbours = 6;
  for (const int n : {2, 3, 7, 50, 500}) {
    const Eigen::MatrixXf similarity = RandomSimilarities(n);
    const ImagePairs pairs = MostSimilarPairs(similarity, kNeighbours);
    for (int i = 0; i < n; ++i) {
      std::vector<int> others;
      for (int j = 0; j < n; ++j) {
        if (j != i) others.push_back(j);
      }
      std::sort(others.begin(), others.end(), [&](int a, int b) { return similarity(a, i) > similarity(b, i); });
      others.resize(std::min<size_t>(others.size(), kNeighbours));
      for (const int j : others) EXPECT_TRUE(Contains(pairs, i, j));
    }
    EXPECT_TRUE(std::is_sorted(pairs.begin(), pairs.end()));
    EXPECT_EQ(std::adjacent_find(pairs.begin(), pairs.end()), pairs.end());
    EXPECT_LE(int(pairs.size()), n * (kNeighbours + 1));
    for (const auto& [a, b] : pairs) EXPECT_TRUE(0 <= a && a < b && b < n);
  }
}

TEST(ImagePairs, GroupsOfPhotosThatAreAlikeStayConnectedByTheirMostSimilarOnes) {
  constexpr int kGroups = 5, kPhotos = 60;
  Eigen::MatrixXf similarity = RandomSimilarities(kPhotos) / 100;
  for (int i = 0; i < kPhotos; ++i) {
    for (int j = 0; j < kPhotos; ++j) similarity(i, j) += i % kGroups == j % kGroups ? 1 : 0;
  }
  similarity(10, 11) = similarity(11, 10) = 0.5;  // of two groups
  const ImagePairs pairs = MostSimilarPairs(similarity, 4);
  EXPECT_EQ(NumGroups(pairs, kPhotos), 1);
  EXPECT_TRUE(Contains(pairs, 10, 11));
}

TEST(ImagePairs, BridgesLeadFromEachPhotoOutsideToThoseInsideThatItIsMostLike) {
  Eigen::MatrixXf similarity = Eigen::MatrixXf::Zero(6, 6);
  const auto set = [&](int a, int b, float value) { similarity(a, b) = similarity(b, a) = value; };
  set(0, 1, 0.9f);  // both outside
  set(0, 3, 0.2f);
  set(0, 5, 0.3f);
  set(1, 2, 0.5f);
  set(1, 4, 0.4f);
  const ImagePairs bridges = BridgingPairs(similarity, {false, false, true, true, true, true}, 2);
  EXPECT_EQ(bridges, (ImagePairs{{0, 3}, {0, 5}, {1, 2}, {1, 4}}));
  EXPECT_EQ(Difference(bridges, {{0, 3}, {1, 4}}), (ImagePairs{{0, 5}, {1, 2}}));
  EXPECT_TRUE(BridgingPairs(similarity, std::vector<bool>(6, true), 2).empty());
}

TEST(ImagePairs, SequentialPairsAreTheNextOnes) {
  EXPECT_THAT(SequentialPairs(4, 2), ::testing::ElementsAre(ImagePair(0, 1), ImagePair(0, 2), ImagePair(1, 2),
                                                            ImagePair(1, 3), ImagePair(2, 3)));
  EXPECT_EQ(AllPairs(11).size(), 55u);
  EXPECT_EQ(Union({{0, 1}, {2, 3}}, {{0, 2}, {2, 3}}), (ImagePairs{{0, 1}, {0, 2}, {2, 3}}));
}

// Lengths of a degree from the tables of WGS 84.
TEST(Gps, DegreesBecomeMetres) {
  const auto apart = [](const GpsPosition& a, const GpsPosition& b) { return -Nearness(LocalPositions({a, b}))(0, 1); };
  EXPECT_NEAR(apart({45, 7, {}}, {45.01, 7, {}}), 1111.3, 0.5);
  EXPECT_NEAR(apart({60, 7, {}}, {60, 7.01, {}}), 558.0, 0.5);
  EXPECT_NEAR(apart({0, 179.995, {}}, {0, -179.995, {}}), 1113.2, 0.5);
  EXPECT_NEAR(apart({45, 7, 100}, {45, 7, 130}), 30, 1e-3);
  EXPECT_NEAR(apart({45, 7, 100}, {45, 7, {}}), 0, 1e-3);
  EXPECT_NEAR(Spread_m(LocalPositions({{0, 0, {}}, {0, 0.001, {}}})), 55.66, 0.05);
  EXPECT_EQ(Spread_m(LocalPositions({})), 0);
}

class Descriptors : public ::testing::Test {
 protected:
  void Make(const std::string& rows) {
    sqlite3* database = nullptr;
    ASSERT_EQ(sqlite3_open(file_.c_str(), &database), SQLITE_OK);
    const std::string sql =
        "CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB);"
        "INSERT INTO descriptors VALUES " +
        rows;
    ASSERT_EQ(sqlite3_exec(database, sql.c_str(), nullptr, nullptr, nullptr), SQLITE_OK);
    sqlite3_close(database);
  }

  TemporaryDirectory dir_;
  std::filesystem::path file_ = dir_.path() / "database.db";
};

TEST_F(Descriptors, AreReadRowByRow) {
  Make("(4, 2, 128, CAST(zeroblob(127) || x'05' || x'09' || zeroblob(127) AS BLOB)), (5, 0, 128, NULL)");
  const FeatureDescriptors descriptors = ReadFeatureDescriptors(file_, 4);
  ASSERT_EQ(descriptors.rows(), 2);
  EXPECT_EQ(descriptors(0, 127), 5);
  EXPECT_EQ(descriptors(1, 0), 9);
  EXPECT_EQ(descriptors.cast<int>().sum(), 14);
  EXPECT_EQ(ReadFeatureDescriptors(file_, 5).rows(), 0);
  EXPECT_EQ(ReadFeatureDescriptors(file_, 6).rows(), 0);
}

TEST_F(Descriptors, OfAnotherSizeAreAnError) {
  for (const std::string rows : {"3", "-2", "9223372036854775807"}) {
    std::filesystem::remove(file_);
    Make("(4, " + rows + ", 128, zeroblob(256))");
    try {
      ReadFeatureDescriptors(file_, 4);
      FAIL();
    } catch (const Error& error) {
      EXPECT_THAT(error.what(), AllOf(HasSubstr("database.db"), HasSubstr(rows + " descriptors in 256 bytes")));
    }
  }
}

}  // namespace
}  // namespace nrff
