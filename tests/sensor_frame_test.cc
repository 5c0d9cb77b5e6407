#include "sfm/sensor_frame.h"

#include <gtest/gtest.h>

#include "sfm/distortion.h"
#include "tests/bundle_fixture.h"

namespace nrff {
namespace {

// 3×2: 0 1 2 / 3 4 5.
Image Numbered() {
  Image image{3, 2, 1, {}};
  for (uint8_t i = 0; i < 6; ++i) image.pixels.push_back(i);
  return image;
}

TEST(SensorFrame, PhotosComeBackAsTheirSensorHadThem) {
  for (const int orientation : {1, 3, 6, 8}) {
    const Image displayed = Oriented(Numbered(), orientation);
    const Image taken = AsSensorHadIt(displayed, orientation);
    EXPECT_EQ(taken.width, 3);
    EXPECT_EQ(taken.pixels, Numbered().pixels) << orientation;
    ImageInfo info;
    info.width = displayed.width;
    info.height = displayed.height;
    info.orientation = orientation;
    EXPECT_EQ(SensorSize(info), std::pair(3, 2));
  }
  for (const int mirrored : {2, 4, 5, 7}) EXPECT_EQ(AsSensorHadIt(Numbered(), mirrored).pixels, Numbered().pixels);
}

// A pixel of the sensor's raster is where Oriented puts it.
TEST(SensorFrame, ObservationsGoWherePixelsGo) {
  for (const int orientation : {1, 3, 6, 8}) {
    const Image displayed = Oriented(Numbered(), orientation);
    for (int y = 0; y < 2; ++y) {
      for (int x = 0; x < 3; ++x) {
        ColmapImage image;
        image.observations.push_back({x + 0.5, y + 0.5, -1});
        TurnImage(image, 3, 2, QuarterTurns(orientation));
        const int column = int(image.observations[0].x), row = int(image.observations[0].y);
        EXPECT_EQ(displayed.pixels[size_t(row * displayed.width + column)], 3 * y + x) << orientation;
      }
    }
  }
}

TEST(SensorFrame, TurnedCamerasAndPosesSeePointsWhereObservationsAre) {
  for (const ColmapCamera& camera : CamerasOfAllModels()) {
    const ColmapModel model = Ring(camera, 4, 60);
    for (int turns = 0; turns < 4; ++turns) {
      const ColmapCamera turned = TurnedCamera(camera, turns);
      const Lens lens(turned);
      EXPECT_EQ(turned.width, turns % 2 == 0 ? 640 : 480);
      for (ColmapImage image : {model.images.at(1), model.images.at(3)}) {
        const Eigen::Vector3d centre = image.Center();
        TurnImage(image, camera.width, camera.height, turns);
        EXPECT_LT((image.Center() - centre).norm(), 1e-12);
        for (const ColmapObservation& seen : image.observations) {
          const Eigen::Vector3d point = model.points.at(uint64_t(seen.point_id)).position;
          const Eigen::Vector3d in_camera = image.rotation * point + image.translation;
          const auto px = lens.ImageFromCamera(in_camera.hnormalized());
          ASSERT_TRUE(px);
          EXPECT_LT((*px - Eigen::Vector2d(seen.x, seen.y)).norm(), 1e-9)
              << CameraModelName(camera.model) << ", " << turns << " turns";
        }
      }
    }
  }
}

}  // namespace
}  // namespace nrff
