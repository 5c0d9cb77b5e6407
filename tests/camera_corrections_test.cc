// Cameras found from what a model shows: exact on a world of known colours, and of use while a model is trained.

#include "model/camera_update.h"

#include <ATen/ATen.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <fstream>
#include <limits>
#include <numbers>
#include <random>

#include "model/trainer.h"
#include "pipeline/error.h"
#include "render/kernels/pixel_ray.h"
#include "tests/ball_scene.h"

namespace nrff {
namespace {

using torch::Tensor;

constexpr int kSize = 64;  // px
constexpr int kViews = 20;
constexpr double kDistance = 2.5;

// A ball of radius 1 in a smooth pattern, along a ray.
struct Shown {
  std::array<double, 3> rgb{1, 1, 1};
  double depth = 0;  // 0: nothing is hit
};
Shown ShowBall(const double* origin, const double* direction) {
  double along = 0, square = 0;
  for (int k = 0; k < 3; ++k) {
    along += origin[k] * direction[k];
    square += origin[k] * origin[k];
  }
  const double root = along * along - square + 1;
  if (root <= 0) return {};
  const double t = -along - std::sqrt(root);
  const auto at = [&](int k) { return origin[k] + t * direction[k]; };
  Shown shown{{}, t};
  for (int c = 0; c < 3; ++c)
    shown.rgb[size_t(c)] =
        0.5 + 0.2 * std::sin(7 * at(c) + 1) + 0.2 * std::cos(6 * at((c + 1) % 3) + 4 * at((c + 2) % 3));
  return shown;
}

RenderedImage ShowRays(const Rays& rays, const Tensor& /*view*/) {
  const int64_t n = rays.origins.size(0);
  const Tensor origins = rays.origins.to(torch::kDouble), directions = rays.directions.to(torch::kDouble);
  RenderedImage image;
  for (int64_t i = 0; i < n; ++i) {
    const Shown shown = ShowBall(origins.const_data_ptr<double>() + 3 * i, directions.const_data_ptr<double>() + 3 * i);
    for (const double value : shown.rgb) image.rgb.push_back(float(value));
    image.depth.push_back(float(shown.depth));
  }
  return image;
}

// Cameras about the ball, and their photos.
class CameraCorrectionsTest : public ::testing::Test {
 protected:
  CameraCorrectionsTest() {
    std::ofstream pack(directory_.path() / kPackFile, std::ios::binary);
    for (int i = 0; i < kViews; ++i) {
      const double azimuth = 2 * std::numbers::pi * i / kViews, height = 0.4 * (i % 3 - 1),
                   norm = std::sqrt(1 + height * height);
      const double c = std::cos(azimuth), s = std::sin(azimuth);
      const Vec3 z{-c / norm, -s / norm, -height / norm}, x{-s, c, 0};
      const Vec3 y{z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0]};
      View view;
      view.id = std::to_string(100000 + i);
      view.width = view.height = kSize;
      view.pack_offset = uint64_t(i) * kSize * kSize * 3;
      view.fx = view.fy = 1.2 * kSize;
      view.cx = view.cy = kSize / 2.;
      view.scene_from_camera[15] = 1;
      for (size_t k = 0; k < 3; ++k) {
        view.scene_from_camera[4 * k] = x[k];
        view.scene_from_camera[4 * k + 1] = y[k];
        view.scene_from_camera[4 * k + 2] = z[k];
        view.scene_from_camera[4 * k + 3] = -kDistance * z[k];
      }
      PinholeCamera camera{view.fx, view.fy, view.cx, view.cy, {}};
      std::copy_n(view.scene_from_camera.begin(), 12, camera.scene_from_camera);
      for (int pixel = 0; pixel < kSize * kSize; ++pixel) {
        double origin[3], direction[3];
        PixelRay(camera, pixel % kSize, pixel / kSize, origin, direction);
        for (const double value : ShowBall(origin, direction).rgb) pack.put(char(std::lround(255 * value)));
      }
      true_.push_back(view);
    }
    pack.close();
    // Wrong by up to about two pixels, and by nothing in common.
    std::mt19937 random(4);
    std::uniform_real_distribution<double> uniform(-1, 1);
    errors_ = CameraCorrections::None(true_);
    for (PoseCorrection& pose : errors_.poses) {
      for (size_t k = 0; k < 3; ++k) {
        pose.turn[k] = 0.015 * uniform(random);
        pose.shift[k] = 0.02 * uniform(random);
      }
    }
    TakeOutCommonMotion(true_, kDistance, errors_.poses);
  }

  std::vector<View> Wrong() const {
    std::vector<View> views;
    for (const View& view : true_) views.push_back(errors_.Corrected(view));
    return views;
  }
  // From the views as given to the corrections of them.
  CameraCorrections Find(const std::vector<View>& given, int n_updates) const {
    const ImagePack pack(directory_.path());
    PixelSource pixels(given, pack, 1);
    CameraCorrections found = CameraCorrections::None(given);
    for (int i = 0; i < n_updates; ++i) {
      found = UpdateCameras(pixels, given, found, ShowRays, {.n_pixels = 300, .seed = 1, .counter = uint64_t(i)})
                  .corrections;
      std::vector<View> moved;
      for (const View& view : given) moved.push_back(found.Corrected(view));
      pixels.MoveViews(moved);
    }
    return found;
  }
  // Of the picture of points of the ball before the camera, px; the largest of all views.
  double LargestError_px(const std::vector<View>& views) const {
    double largest = 0;
    for (size_t i = 0; i < views.size(); ++i) {
      for (const auto& [x, y] : {std::pair(0., 0.), {0.5, 0.}, {-0.5, 0.}, {0., 0.5}, {0., -0.5}}) {
        const Mat4& m = true_[i].scene_from_camera;
        Vec3 point{};
        for (size_t k = 0; k < 3; ++k)
          point[k] = x * m[4 * k] + y * m[4 * k + 1] - std::sqrt(1 - x * x - y * y) * m[4 * k + 2];
        const auto [u, v] = Project(views[i], point);
        const auto [true_u, true_v] = Project(true_[i], point);
        largest = std::max(largest, std::hypot(u - true_u, v - true_v));
      }
    }
    return largest;
  }
  static std::pair<double, double> Project(const View& view, const Vec3& point) {
    const Mat4& m = view.scene_from_camera;
    Vec3 at{};
    for (size_t k = 0; k < 3; ++k) {
      for (size_t row = 0; row < 3; ++row) at[k] += m[4 * row + k] * (point[row] - m[4 * row + 3]);
    }
    return {view.fx * at[0] / at[2] + view.cx, view.fy * at[1] / at[2] + view.cy};
  }
  static std::vector<View> Corrected(const std::vector<View>& views, const CameraCorrections& corrections) {
    std::vector<View> corrected;
    for (const View& view : views) corrected.push_back(corrections.Corrected(view));
    return corrected;
  }

  TemporaryDirectory directory_;
  std::vector<View> true_;
  CameraCorrections errors_;
};

TEST_F(CameraCorrectionsTest, WrongPosesAreFound) {
  const std::vector<View> wrong = Wrong();
  EXPECT_GT(LargestError_px(wrong), 1.5);
  EXPECT_LT(LargestError_px(Corrected(wrong, Find(wrong, 1))), 0.8);
  EXPECT_LT(LargestError_px(Corrected(wrong, Find(wrong, 5))), 0.08);
}

TEST_F(CameraCorrectionsTest, RightOnesStay) { EXPECT_LT(LargestError_px(Corrected(true_, Find(true_, 3))), 0.05); }

TEST_F(CameraCorrectionsTest, AWrongFocalLengthIsFoundAndHeldOutViewsHaveIt) {
  std::vector<View> wrong = true_;
  for (View& view : wrong) {
    view.fx *= 1.01;
    view.fy *= 1.01;
  }
  const CameraCorrections found = Find(wrong, 5);
  ASSERT_EQ(found.intrinsics.size(), 1u);
  EXPECT_NEAR(found.intrinsics[0].log_focal, -std::log(1.01), 0.003);
  View held_out = wrong[0];
  held_out.id = "another";
  EXPECT_NEAR(found.Corrected(held_out).fx, true_[0].fx, 0.003 * true_[0].fx);
  EXPECT_EQ(found.Corrected(held_out).scene_from_camera, held_out.scene_from_camera);
  held_out.width += 1;  // of another camera
  EXPECT_EQ(found.Corrected(held_out).fx, held_out.fx);
}

// The model follows where all cameras go; only the held-out ones would not.
TEST_F(CameraCorrectionsTest, ASimilarityOfTheWorldIsNoCorrection) {
  CameraCorrections common = CameraCorrections::None(true_);
  for (size_t i = 0; i < true_.size(); ++i) {
    const Mat4& m = true_[i].scene_from_camera;
    const Vec3 turn{0.003, -0.002, 0.004}, centre{m[3], m[7], m[11]};
    const Vec3 shift{turn[1] * centre[2] - turn[2] * centre[1] + 0.01 + 0.005 * centre[0],
                     turn[2] * centre[0] - turn[0] * centre[2] - 0.02 + 0.005 * centre[1],
                     turn[0] * centre[1] - turn[1] * centre[0] + 0.005 * centre[2]};
    for (size_t k = 0; k < 3; ++k) {
      for (size_t row = 0; row < 3; ++row) {
        common.poses[i].turn[k] += m[4 * row + k] * turn[row];
        common.poses[i].shift[k] += m[4 * row + k] * shift[row];
      }
    }
  }
  TakeOutCommonMotion(true_, kDistance, common.poses);
  for (const PoseCorrection& pose : common.poses) {
    for (size_t k = 0; k < 3; ++k) {
      EXPECT_NEAR(pose.turn[k], 0, 1e-8);
      EXPECT_NEAR(pose.shift[k], 0, 1e-8);
    }
  }
  std::vector<PoseCorrection> one(errors_.poses.begin(), errors_.poses.begin() + 1);  // alone, it has all in common
  TakeOutCommonMotion({true_[0]}, kDistance, one);
  EXPECT_NEAR(one[0].shift[0], 0, 1e-6);
}

TEST_F(CameraCorrectionsTest, ViewsThatAreAddedHaveNone) {
  CameraCorrections known = errors_;
  known.intrinsics[0].log_focal = 0.01;
  std::vector<View> more(true_.rbegin(), true_.rend());
  more.push_back(true_[0]);
  more.back().id = "added";
  const CameraCorrections all = known.Of(more);
  EXPECT_EQ(all.poses.size(), size_t(kViews + 1));
  EXPECT_EQ(all.Corrected(true_[2]).scene_from_camera, known.Corrected(true_[2]).scene_from_camera);
  EXPECT_EQ(all.Corrected(more.back()).scene_from_camera, more.back().scene_from_camera);
  EXPECT_EQ(all.Corrected(more.back()).fx, known.Corrected(true_[0]).fx);
  EXPECT_EQ(all.poses[0].view, true_.back().id);
}

TEST_F(CameraCorrectionsTest, JsonHoldsThemAndRefusesWhatIsNotFinite) {
  CameraCorrections errors = errors_;
  errors.intrinsics[0].log_focal = 0.01;
  const Json json = errors;
  EXPECT_EQ(Json(json.get<CameraCorrections>()), json);
  EXPECT_EQ(Json::parse(json.dump()).get<CameraCorrections>().Corrected(true_[3]).scene_from_camera,
            errors.Corrected(true_[3]).scene_from_camera);
  Json broken = json;
  broken["poses"][2]["turn"][1] = std::numeric_limits<double>::quiet_NaN();
  EXPECT_ANY_THROW(broken.get<CameraCorrections>());
  broken = json;
  broken["poses"][2].erase("shift");
  EXPECT_ANY_THROW(broken.get<CameraCorrections>());
}

// Photos of the ball in its pattern, two of them held out, and cameras as wrong as errors_.
class TrainingWithWrongCameras : public CameraCorrectionsTest {
 protected:
  TrainingWithWrongCameras() : pack_(directory_.path()) {
    SetThreads(1);
    scene_.background = Background::kWhite;
    scene_.aabb_min = {-1.1, -1.1, -1.1};
    scene_.aabb_max = {1.1, 1.1, 1.1};
    scene_.near = 0.5;
    scene_.far = 5;
    scene_.views = Wrong();
    for (const size_t i : {4, 12}) {
      scene_.views[i] = true_[i];
      scene_.views[i].split = Split::kTest;
    }
    preset_ = MakePreset("tiny", false);
    preset_.train.steps = 500;
    preset_.train.occupancy_resolution = 32;
    preset_.train.camera_least_px = 0;
  }
  double HeldOutPsnr(const std::vector<double>& moments) {
    preset_.train.camera_moments = moments;
    Trainer trainer(scene_, pack_, {}, preset_, {.seed = 3});
    while (!trainer.Done()) trainer.Step();
    n_corrected_ = trainer.state().cameras.poses.size();
    return HeldOutViews(scene_, pack_, 1)
        .Psnr([&](const View& view, const Rays& rays) { return trainer.RenderMean(view, rays); },
              [&](const View& view) { return trainer.Corrected(view); });
  }

  ImagePack pack_;
  Scene scene_;
  Preset preset_;
  size_t n_corrected_ = 0;
};

TEST_F(TrainingWithWrongCameras, CorrectedOnesShowMore) {
  const double without = HeldOutPsnr({}), with = HeldOutPsnr({0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5});
  EXPECT_EQ(n_corrected_, size_t(kViews - 2));
  EXPECT_GT(with, without + 1);
}

TEST_F(TrainingWithWrongCameras, ThoseThatHardlyMoveStay) {
  preset_.train.steps = 40;
  preset_.train.camera_moments = {0.5, 0.6};
  preset_.train.camera_least_px = 1e6;
  Trainer trainer(scene_, pack_, {}, preset_, {.seed = 3});
  while (!trainer.Done()) trainer.Step();
  EXPECT_GT(trainer.state().camera_first_px, 0);
  EXPECT_TRUE(trainer.state().cameras.poses.empty());
  EXPECT_EQ(trainer.Corrected(scene_.views[0]).scene_from_camera, scene_.views[0].scene_from_camera);
}

}  // namespace
}  // namespace nrff
