// Lens models and resampling: round trips, closed forms, OpenCV as an independent witness, folds.
#include "sfm/distortion.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <opencv2/calib3d.hpp>
#include <random>

#include "pipeline/error.h"
#include "sfm/undistort.h"

namespace nrff {
namespace {

using Eigen::Vector2d;

uint8_t& Channel(Image& image, int x, int y, int c) {
  return image.pixels[(size_t(y) * image.width + x) * image.channels + c];
}

ColmapCamera Camera(CameraModel model, std::vector<double> params, int width = 640, int height = 480) {
  return {1, model, width, height, std::move(params)};
}

// One of each model, with distortion as real lenses have it.
std::vector<ColmapCamera> AllModels() {
  return {Camera(CameraModel::kSimplePinhole, {500, 320, 240}),
          Camera(CameraModel::kPinhole, {500, 505, 318, 243}),
          Camera(CameraModel::kSimpleRadial, {500, 318, 243, -0.12}),
          Camera(CameraModel::kRadial, {500, 318, 243, -0.2, 0.05}),
          Camera(CameraModel::kOpenCV, {500, 505, 318, 243, -0.2, 0.06, 0.002, -0.003}),
          Camera(CameraModel::kOpenCVFisheye, {300, 305, 318, 243, -0.02, 0.01, -0.004, 0.001}),
          Camera(CameraModel::kFullOpenCV, {500, 505, 318, 243, -0.2, 0.06, 0.002, -0.003, 0.01, 0.03, -0.02, 0.004}),
          Camera(CameraModel::kFov, {400, 405, 318, 243, 0.9}),
          Camera(CameraModel::kSimpleRadialFisheye, {300, 318, 243, -0.03}),
          Camera(CameraModel::kRadialFisheye, {300, 318, 243, -0.03, 0.005}),
          Camera(CameraModel::kThinPrismFisheye,
                 {300, 305, 318, 243, -0.02, 0.01, 0.001, -0.002, -0.003, 0.001, 0.002, -0.001})};
}

TEST(Lens, EveryModelUndoesItself) {
  for (const ColmapCamera& camera : AllModels()) {
    SCOPED_TRACE(CameraModelName(camera.model));
    const Lens lens(camera);
    for (int y = 0; y <= camera.height; y += 16) {
      for (int x = 0; x <= camera.width; x += 16) {
        const auto uv = lens.CameraFromImage({x, y});
        ASSERT_TRUE(uv) << x << ", " << y;
        const auto px = lens.ImageFromCamera(*uv);
        ASSERT_TRUE(px);
        EXPECT_LT((*px - Vector2d(x, y)).norm(), 1e-8) << x << ", " << y;
        const auto again = lens.CameraFromImage(*px);
        ASSERT_TRUE(again);
        EXPECT_LT((*again - *uv).norm(), 1e-10);
      }
    }
  }
}

TEST(Lens, BrownAndFisheyeModelsAgreeWithOpenCV) {
  std::mt19937 random(1);
  std::uniform_real_distribution<double> coordinate(-0.6, 0.6);
  std::vector<cv::Point3d> points;
  points.reserve(200);
  for (int i = 0; i < 200; ++i) points.emplace_back(coordinate(random), coordinate(random), 1);
  const cv::Vec3d zero(0, 0, 0);
  const cv::Matx33d intrinsics(500, 0, 318, 0, 505, 243, 0, 0, 1);
  const std::vector<double> brown = {-0.2, 0.06, 0.002, -0.003, 0.01, 0.03, -0.02, 0.004};
  std::vector<cv::Point2d> projected;
  const auto expect_equal = [&](const ColmapCamera& camera) {
    const Lens lens(camera);
    for (size_t i = 0; i < points.size(); ++i) {
      const auto px = lens.ImageFromCamera({points[i].x, points[i].y});
      ASSERT_TRUE(px);
      EXPECT_NEAR(px->x(), projected[i].x, 1e-9);
      EXPECT_NEAR(px->y(), projected[i].y, 1e-9);
    }
  };
  cv::projectPoints(points, zero, zero, intrinsics, brown, projected);
  expect_equal(
      Camera(CameraModel::kFullOpenCV, {500, 505, 318, 243, -0.2, 0.06, 0.002, -0.003, 0.01, 0.03, -0.02, 0.004}));
  cv::projectPoints(points, zero, zero, intrinsics, std::vector<double>(brown.begin(), brown.begin() + 4), projected);
  expect_equal(Camera(CameraModel::kOpenCV, {500, 505, 318, 243, -0.2, 0.06, 0.002, -0.003}));
  cv::fisheye::projectPoints(points, projected, zero, zero, intrinsics, cv::Vec4d(-0.02, 0.01, -0.004, 0.001));
  expect_equal(Camera(CameraModel::kOpenCVFisheye, {500, 505, 318, 243, -0.02, 0.01, -0.004, 0.001}));
}

TEST(Lens, RadialModelsHaveTheirClosedForms) {
  const Vector2d uv(0.3, -0.4);  // r = 0.5
  const double r = 0.5;
  const auto radius = [&](const ColmapCamera& camera) { return Lens(camera).ImageFromCamera(uv)->norm(); };
  EXPECT_NEAR(radius(Camera(CameraModel::kSimpleRadial, {1, 0, 0, -0.2})), r * (1 - 0.2 * r * r), 1e-15);
  EXPECT_NEAR(radius(Camera(CameraModel::kRadial, {1, 0, 0, -0.2, 0.1})), r * (1 - 0.2 * r * r + 0.1 * r * r * r * r),
              1e-15);
  const double theta = std::atan(r);
  EXPECT_NEAR(radius(Camera(CameraModel::kSimpleRadialFisheye, {1, 0, 0, 0.1})), theta * (1 + 0.1 * theta * theta),
              1e-15);
  EXPECT_NEAR(radius(Camera(CameraModel::kFov, {1, 1, 0, 0, 0.9})), std::atan(2 * r * std::tan(0.45)) / 0.9, 1e-15);
  // Thin prism: the terms are polynomials of the equidistant coordinates.
  const Vector2d a = uv * (theta / r);
  const double s2 = a.squaredNorm();
  const auto prism = Lens(Camera(CameraModel::kThinPrismFisheye, {1, 1, 0, 0, 0, 0, 0.01, 0.02, 0, 0, 0.03, 0.04}))
                         .ImageFromCamera(uv);
  EXPECT_NEAR(prism->x(), a.x() + 0.02 * a.x() * a.y() + 0.02 * (s2 + 2 * a.x() * a.x()) + 0.03 * s2, 1e-15);
  EXPECT_NEAR(prism->y(), a.y() + 0.04 * a.x() * a.y() + 0.01 * (s2 + 2 * a.y() * a.y()) + 0.04 * s2, 1e-15);
}

TEST(Lens, BeyondTheFoldThereIsNoAnswer) {
  // r (1 + k r²) turns back at r = 1/√(−3k).
  const Lens lens(Camera(CameraModel::kSimpleRadial, {100, 320, 240, -0.3}));
  const double fold = 1 / std::sqrt(0.9);
  EXPECT_NEAR(lens.ValidRadius(), fold, 1e-9);
  EXPECT_TRUE(lens.ImageFromCamera({0.999 * fold, 0}));
  EXPECT_FALSE(lens.ImageFromCamera({1.001 * fold, 0}));
  const double edge_px = 100 * fold * (1 - 0.3 * fold * fold);
  const auto inside = lens.CameraFromImage({320 + 0.9999 * edge_px, 240});
  ASSERT_TRUE(inside);
  EXPECT_LT(inside->norm(), fold);
  EXPECT_FALSE(lens.CameraFromImage({320 + 1.0001 * edge_px, 240}));
  // Where OpenCV's iteration diverges without saying so.
  const auto far = lens.CameraFromImage({320 + 100 * (1 - 0.3), 240});
  ASSERT_TRUE(far);
  EXPECT_NEAR(far->x(), 1, 1e-10);
}

TEST(Lens, AFisheyePixelAtRightAnglesHasNoPinholeRay) {
  const Lens lens(Camera(CameraModel::kOpenCVFisheye, {100, 100, 320, 240, 0, 0, 0, 0}));
  EXPECT_TRUE(lens.CameraFromImage({320 + 150, 240}));
  EXPECT_FALSE(lens.CameraFromImage({320 + 160, 240}));  // θ = 1.6 > π/2
  EXPECT_FALSE(lens.CameraFromImage({320 + 200, 240}));
}

TEST(Lens, RejectsCamerasThatMakeNoSense) {
  EXPECT_THROW(Lens(Camera(CameraModel::kPinhole, {500, 500, 320})), Error);
  EXPECT_THROW(Lens(Camera(CameraModel::kPinhole, {-500, 500, 320, 240})), Error);
  EXPECT_THROW(Lens(Camera(CameraModel::kPinhole, {NAN, 500, 320, 240})), Error);
}

TEST(Undistort, EveryPixelOfTheTargetHasASource) {
  std::vector<ColmapCamera> cameras = AllModels();
  cameras.push_back(Camera(CameraModel::kSimpleRadial, {300, 320, 240, -0.3}));              // folds inside the photo
  cameras.push_back(Camera(CameraModel::kSimpleRadial, {400, 320, 240, 0.4}));               // pincushion
  cameras.push_back(Camera(CameraModel::kOpenCVFisheye, {160, 160, 320, 240, 0, 0, 0, 0}));  // 230° across
  for (const ColmapCamera& camera : cameras) {
    SCOPED_TRACE(CameraModelName(camera.model));
    const Lens lens(camera);
    const PinholeTarget target = UndistortedTarget(lens, 400);
    EXPECT_LE(std::max(target.width, target.height), 400);
    for (int y = 0; y < target.height; ++y) {
      for (int x = 0; x < target.width; ++x) {
        const auto px = lens.ImageFromCamera({(x + 0.5 - target.cx) / target.fx, (y + 0.5 - target.cy) / target.fy});
        ASSERT_TRUE(px) << x << ", " << y;
        ASSERT_TRUE(px->x() >= 0 && px->y() >= 0 && px->x() <= camera.width && px->y() <= camera.height)
            << x << ", " << y;
      }
    }
  }
}

TEST(Undistort, TheTargetIsAsLargeAsThePhotoAllows) {
  // Barrel distortion, symmetric: the middles of the photo's edges bound the field.
  const Lens lens(Camera(CameraModel::kSimpleRadial, {500, 320, 240, -0.1}));
  const PinholeTarget target = UndistortedTarget(lens, 10000);
  EXPECT_NEAR(target.width, 2 * 500 * lens.CameraFromImage({640, 240})->x(), 1);
  EXPECT_NEAR(target.height, 2 * 500 * lens.CameraFromImage({320, 480})->y(), 1);
}

TEST(Undistort, ShowsWhatAPinholeCameraWouldSee) {
  // A smooth pattern on the plane z = 1, seen through the lens, must come out as seen without it.
  const auto pattern = [](const Vector2d& uv, int c) {
    return 128 + 100 * std::sin(6 * uv.x() + c) * std::cos(5 * uv.y());
  };
  const Lens lens(Camera(CameraModel::kOpenCV, {500, 505, 318, 243, -0.2, 0.06, 0.002, -0.003}));
  Image photo{640, 480, 3, std::vector<uint8_t>(640 * 480 * 3)};
  for (int y = 0; y < 480; ++y) {
    for (int x = 0; x < 640; ++x) {
      const auto uv = lens.CameraFromImage({x + 0.5, y + 0.5});
      ASSERT_TRUE(uv);
      for (int c = 0; c < 3; ++c) Channel(photo, x, y, c) = uint8_t(std::lround(pattern(*uv, c)));
    }
  }
  for (const int max_size : {640, 250}) {
    const PinholeTarget target = UndistortedTarget(lens, max_size);
    Image image = Resample(photo, lens, target);
    double largest = 0;
    for (int y = 0; y < target.height; ++y) {
      for (int x = 0; x < target.width; ++x) {
        const Vector2d uv((x + 0.5 - target.cx) / target.fx, (y + 0.5 - target.cy) / target.fy);
        for (int c = 0; c < 3; ++c) {
          largest = std::max(largest, std::abs(Channel(image, x, y, c) - pattern(uv, c)));
        }
      }
    }
    EXPECT_LT(largest, 1.5) << max_size;
  }
}

Image Noise(int width, int height, int channels) {
  Image image{width, height, channels, std::vector<uint8_t>(size_t(width) * height * channels)};
  std::mt19937 random(7);
  for (uint8_t& value : image.pixels) value = uint8_t(random());
  return image;
}

TEST(Resample, APhotoThatKeepsItsSizeIsCopied) {
  const Lens lens(Camera(CameraModel::kPinhole, {500, 505, 31, 24}, 61, 47));
  const Image photo = Noise(61, 47, 3);
  const PinholeTarget target = ScaledTarget(lens, 1000);
  EXPECT_EQ(target.width, 61);
  EXPECT_DOUBLE_EQ(target.cx, 31);
  EXPECT_EQ(Resample(photo, lens, target).pixels, photo.pixels);
}

TEST(Resample, ScalingDownAveragesEveryPixel) {
  const Lens lens(Camera(CameraModel::kPinhole, {500, 505, 31, 24}, 60, 48));
  Image photo = Noise(60, 48, 3);
  Image small = Resample(photo, lens, ScaledTarget(lens, 20));
  ASSERT_EQ(small.width, 20);
  ASSERT_EQ(small.height, 16);
  for (int y = 0; y < 16; ++y) {
    for (int x = 0; x < 20; ++x) {
      for (int c = 0; c < 3; ++c) {
        double sum = 0;
        for (int b = 0; b < 3; ++b) {
          for (int a = 0; a < 3; ++a) sum += Channel(photo, 3 * x + a, 3 * y + b, c);
        }
        EXPECT_NEAR(Channel(small, x, y, c), sum / 9, 0.51);
      }
    }
  }
}

TEST(Resample, ColoursOfTransparentPixelsDoNotBleed) {
  const Lens lens(Camera(CameraModel::kPinhole, {500, 500, 2, 2}, 4, 4));
  Image photo{4, 4, 4, std::vector<uint8_t>(64)};
  for (size_t i = 0; i < 16; ++i) {
    const bool opaque = i % 2 == 0;
    photo.pixels[4 * i] = opaque ? 200 : 10;
    photo.pixels[4 * i + 3] = opaque ? 255 : 0;
  }
  const Image small = Resample(photo, lens, ScaledTarget(lens, 2));
  for (size_t i = 0; i < 4; ++i) {
    EXPECT_EQ(small.pixels[4 * i], 200);
    EXPECT_EQ(small.pixels[4 * i + 3], 128);
  }
}

TEST(Undistort, DisplacementIsMeasuredAtTheTargetsSize) {
  const Lens lens(Camera(CameraModel::kSimpleRadial, {500, 320, 240, -0.05}));
  const Vector2d corner = *lens.CameraFromImage({0, 0}) * 500 + Vector2d(320, 240);
  EXPECT_NEAR(LargestDisplacement(lens, 640), corner.norm(), 1e-9);
  EXPECT_NEAR(LargestDisplacement(lens, 64), corner.norm() / 10, 1e-9);
  EXPECT_EQ(LargestDisplacement(Lens(Camera(CameraModel::kSimplePinhole, {500, 300, 200})), 640), 0);
  EXPECT_EQ(LargestDisplacement(Lens(Camera(CameraModel::kSimpleRadial, {300, 320, 240, -0.3})), 640),
            std::numeric_limits<double>::infinity());
}

}  // namespace
}  // namespace nrff
