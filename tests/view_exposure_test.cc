// Exposures of views, from points and from EXIF, against the gains that the pictures were made with.
#include "sfm/view_exposure.h"

#include <gtest/gtest.h>

#include <cmath>
#include <fstream>
#include <random>

#include "tests/temporary_directory.h"

namespace nrff {
namespace {

constexpr int kWidth = 60, kHeight = 40;

// Views 0, 4, 8, … are held out. Point p lies in each view at one place, in blocks of 3×3 px of its colour times the
// view's gain; every tenth sighting shows something else.
class ViewExposure : public ::testing::Test {
 protected:
  void Make(int n_views, const std::vector<Vec3>& gains, int n_points) {
    std::mt19937 random(5);
    std::uniform_real_distribution<double> colour(60, 120), other(30, 200);
    std::vector<std::vector<uint8_t>> pixels(size_t(n_views), std::vector<uint8_t>(3 * kWidth * kHeight, 100));
    uint64_t offset = 0;
    for (int v = 0; v < n_views; ++v) {
      View view;
      view.width = kWidth;
      view.height = kHeight;
      view.split = v % 4 == 0 ? Split::kTest : Split::kTrain;
      view.pack_offset = offset;
      offset += view.PixelBytes();
      scene_.views.push_back(view);
      model_.images[uint32_t(v + 1)].id = uint32_t(v + 1);
      view_of_image_[uint32_t(v + 1)] = uint32_t(v);
    }
    for (int p = 0; p < n_points; ++p) {
      const int x = 3 * (p % (kWidth / 3)) + 1, y = 3 * (p / (kWidth / 3)) + 1;
      const Vec3 own = {colour(random), colour(random), colour(random)};
      ColmapPoint& point = model_.points[uint64_t(p + 1)];
      for (int v = 0; v < n_views; ++v) {
        if (v != p % n_views && v != (p + 1) % n_views && v != (p + 2) % n_views) continue;  // a ring of overlaps
        const bool wrong = random() % 10 == 0;
        for (int k = 0; k < 9; ++k) {
          uint8_t* pixel = &pixels[size_t(v)][size_t(3 * ((y + k / 3 - 1) * kWidth + x + k % 3 - 1))];
          for (size_t c = 0; c < 3; ++c) {
            pixel[c] = uint8_t(std::lround(wrong ? other(random) : own[c] * gains[size_t(v)][c]));
          }
        }
        ColmapImage& image = model_.images[uint32_t(v + 1)];
        point.track.emplace_back(uint32_t(v + 1), uint32_t(image.observations.size()));
        image.observations.push_back({x + 0.5, y + 0.5, p + 1});
      }
    }
    std::ofstream pack(dir_.path() / kPackFile, std::ios::binary);
    for (const auto& view : pixels) pack.write(reinterpret_cast<const char*>(view.data()), std::ptrdiff_t(view.size()));
    pack.close();
    written_.resize(size_t(n_views));
  }

  ViewExposures Measure() const {
    return MeasureViewExposures(model_, view_of_image_, scene_, ImagePack(dir_.path()), written_);
  }

  TemporaryDirectory dir_;
  Scene scene_;
  ColmapModel model_;
  std::map<uint32_t, uint32_t> view_of_image_;
  std::vector<WrittenExposure> written_;
};

TEST_F(ViewExposure, PointsGiveEveryTrainingViewItsGainDespiteWrongMatches) {
  std::vector<Vec3> gains;
  for (int v = 0; v < 12; ++v) {
    gains.push_back({std::exp(0.4 * std::sin(v)), std::exp(0.3 * std::sin(v)), std::exp(0.2 * std::cos(v))});
  }
  Make(12, gains, 260);
  const ViewExposures found = Measure();
  EXPECT_EQ(found.source, "points");
  for (size_t c = 0; c < 3; ++c) {
    double mean = 0;
    for (size_t v = 0; v < 12; ++v) mean += v % 4 == 0 ? 0 : std::log(gains[v][c]) / 9;
    for (size_t v = 0; v < 12; ++v) {
      const double expected = v % 4 == 0 ? 0 : std::log(gains[v][c]) - mean;
      EXPECT_NEAR(std::log(found.gain[v][c]), expected, 0.03) << v << " " << c;
    }
  }
}

TEST_F(ViewExposure, NothingOfHeldOutViewsIsUsed) {
  std::vector<Vec3> gains(12, Vec3{1, 1, 1});
  Make(12, gains, 260);
  const ViewExposures found = Measure();
  for (ColmapImage* image : {&model_.images[1], &model_.images[5]}) {
    for (ColmapObservation& observation : image->observations) observation.x += 9;  // other colours
  }
  EXPECT_EQ(Measure().gain, found.gain);
}

TEST_F(ViewExposure, ExifCountsWhereThereAreNoPointsAndEveryTrainingPhotoHasIt) {
  Make(8, std::vector<Vec3>(8, Vec3{1, 1, 1}), 0);
  EXPECT_EQ(Measure().source, "none");
  EXPECT_EQ(Measure().gain, std::vector<Vec3>(8, Vec3{1, 1, 1}));
  for (size_t v = 0; v < 8; ++v) written_[v] = {1. / (v < 4 ? 100 : 400), 2., 100.};
  const ViewExposures found = Measure();
  EXPECT_EQ(found.source, "EXIF");
  // Four times the light is two stops, and held-out views have none.
  EXPECT_NEAR(found.gain[1][0] / found.gain[5][0], std::exp2(2 / kDisplayGamma), 1e-12);
  EXPECT_EQ(found.gain[0], (Vec3{1, 1, 1}));
  for (size_t v = 0; v < 8; ++v) scene_.views[v].colour_gain = found.gain[v];
  EXPECT_NEAR(ExposureSpread(scene_), 1, 1e-9);
  written_[2].iso.reset();
  EXPECT_EQ(Measure().source, "none");
}

}  // namespace
}  // namespace nrff
