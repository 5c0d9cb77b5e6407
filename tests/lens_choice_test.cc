// Which camera model photos need, on models whose true lenses are known; and the made captures' rays against them.
#include "sfm/lens_choice.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "examples/ray_tracer.h"
#include "tests/bundle_fixture.h"

namespace nrff {
namespace {

// As mapping with SIMPLE_RADIAL lenses leaves it: observations of `truth`, half a pixel off, and a lens near to it.
ColmapModel MappedWithSimpleLens(const ColmapCamera& truth, double k, int n_images = 12) {
  ColmapModel model = Ring(truth, n_images, 300);
  AddNoise(model, 0.5, 5);
  model.cameras.at(truth.id) = {truth.id,
                                CameraModel::kSimpleRadial,
                                truth.width,
                                truth.height,
                                {truth.params[0], truth.width / 2.0, truth.height / 2.0, k}};
  return model;
}

ColmapCamera Camera(CameraModel model, std::vector<double> params) { return {1, model, 640, 480, std::move(params)}; }

TEST(LensChoice, TheSimpleModelStaysWhereItIsTrue) {
  const LensChoice choice =
      ChooseLens(MappedWithSimpleLens(Camera(CameraModel::kSimpleRadial, {400, 321, 239, -0.08}), -0.08), true, 1);
  ASSERT_EQ(choice.trials.size(), 4u);
  EXPECT_EQ(choice.chosen, CameraModel::kSimpleRadial);
  EXPECT_FALSE(choice.decision->needed);
  EXPECT_EQ(choice.decision->feature, "richer_lens");
  for (const LensTrial& trial : choice.trials) EXPECT_NEAR(trial.error_px, choice.trials[0].error_px, 0.01);
}

TEST(LensChoice, RicherModelsAreTakenWhereTheyPredictWhatTheyWereNotFittedTo) {
  const LensChoice radial =
      ChooseLens(MappedWithSimpleLens(Camera(CameraModel::kRadial, {400, 321, 239, -0.25, 0.12}), -0.1), true, 1);
  EXPECT_EQ(radial.chosen, CameraModel::kRadial);
  EXPECT_TRUE(radial.decision->needed);
  const LensChoice fisheye = ChooseLens(
      MappedWithSimpleLens(Camera(CameraModel::kOpenCVFisheye, {260, 260, 321, 239, -0.02, 0.01, -0.004, 0.001}), -0.1),
      true, 1);
  EXPECT_EQ(fisheye.chosen, CameraModel::kOpenCVFisheye);
}

TEST(LensChoice, FocalLengthsAreEachPhotosOwnWhereThatPredictsMore) {
  const ColmapCamera camera = Camera(CameraModel::kSimpleRadial, {400, 320, 240, -0.08});
  const ColmapModel zoomed = ZoomedRing(camera, 12, 300, 0.5, 0.1);
  EXPECT_TRUE(needs::OwnFocalLengths(*TryOwnFocalLengths(zoomed, 1)).needed);
  EXPECT_FALSE(needs::OwnFocalLengths(*TryOwnFocalLengths(ZoomedRing(camera, 12, 300, 0.5, 0), 1)).needed);
  const auto [own, certificate] = WithOwnFocalLengths(zoomed, 1);
  EXPECT_TRUE(certificate.accepted);
  ASSERT_EQ(own.cameras.size(), 12u);
  for (const auto& [id, camera] : own.cameras) {
    EXPECT_EQ(own.images.at(id).camera_id, id);
    EXPECT_NEAR(camera.params[0], 400 * ZoomOf(id, 12, 0.1), 1.5);
    EXPECT_EQ(camera.params[1], 320);
    EXPECT_EQ(camera.params[3], own.cameras.begin()->second.params[3]);
  }
  EXPECT_FALSE(TryOwnFocalLengths(own, 1));
}

TEST(LensChoice, ARicherLensIsNotTakenForZoomedPhotos) {
  // Photos from one side are zoomed in, and mapping has bent them into place.
  const auto zoom_of = [](uint32_t id) { return 1 + 0.3 * std::cos(2 * M_PI * id / 12); };
  const ColmapModel zoomed =
      RefineBundle(ZoomedRing(Camera(CameraModel::kSimpleRadial, {400, 320, 240, -0.08}), 12, 300, 0.3, zoom_of),
                   {.principal_points = false})
          .model;
  EXPECT_NE(ChooseLens(zoomed, false, 1).chosen, CameraModel::kSimpleRadial);
  const LensChoice choice = ChooseLens(zoomed, true, 1);
  EXPECT_EQ(choice.chosen, CameraModel::kSimpleRadial);
  EXPECT_EQ(choice.decision->reason, "a lens that was zoomed describes the photos better");
}

TEST(LensChoice, PhotosMappedWithCamerasOfTheirOwnShareDistortionAndPrincipalPoint) {
  const ColmapCamera camera = Camera(CameraModel::kSimpleRadial, {400, 320, 240, -0.08});
  const ColmapModel shared = ZoomedRing(camera, 12, 300, 0.3, 0.1);
  ColmapModel mapped = WithOwnFocalLengths(shared, 1).model;
  for (auto& [id, own] : mapped.cameras) {
    own.params[1] = 330;
    own.params[3] = id == 5 ? 0.5 : -0.08 + 1e-4 * id;
  }
  const auto [own, certificate] = WithOwnFocalLengths(mapped, shared, 1);
  ASSERT_TRUE(certificate.accepted);
  for (const auto& [id, one] : own.cameras) {
    EXPECT_NEAR(one.params[0], 400 * ZoomOf(id, 12, 0.1), 1.5);
    EXPECT_EQ(one.params[1], 320);
    EXPECT_NEAR(one.params[3], -0.08, 2e-3);
    EXPECT_EQ(one.params[3], own.cameras.begin()->second.params[3]);
  }
}

TEST(LensChoice, FocalLengthsThatNothingFixesStayShared) {
  ColmapModel two = Ring(Camera(CameraModel::kSimpleRadial, {400, 320, 240, -0.08}), 12, 300);
  two.points.clear();
  for (auto& [id, image] : two.images) image.observations.clear();
  const auto [model, certificate] = WithOwnFocalLengths(two, 1);
  EXPECT_FALSE(certificate.accepted);
  EXPECT_FALSE(certificate.reason.empty());
  EXPECT_EQ(model.cameras.size(), 1u);
  EXPECT_EQ(model.images.at(3).camera_id, 1u);
}

TEST(LensChoice, OfTooFewPhotosOrPointsNothingIsSaid) {
  const ColmapCamera camera = Camera(CameraModel::kRadial, {400, 321, 239, -0.25, 0.12});
  EXPECT_TRUE(ChooseLens(MappedWithSimpleLens(camera, -0.1, 4), true, 1).trials.empty());
  ColmapModel few = MappedWithSimpleLens(camera, -0.1);
  while (few.points.size() >= kFewestHeldOut) {
    for (const auto& [image, index] : few.points.rbegin()->second.track)
      few.images.at(image).observations[index].point_id = -1;
    few.points.erase(std::prev(few.points.end()));
  }
  EXPECT_TRUE(ChooseLens(few, true, 1).trials.empty());
}

TEST(LensChoice, ConvertedCamerasSeeTheSame) {
  const ColmapCamera simple = Camera(CameraModel::kSimpleRadial, {400, 318, 243, -0.08});
  for (const auto& [model, tolerance_px] :
       {std::pair(CameraModel::kRadial, 1e-9), {CameraModel::kOpenCV, 1e-9}, {CameraModel::kOpenCVFisheye, 0.02}}) {
    const ColmapCamera converted = WithCameraModel(simple, model);
    ASSERT_EQ(converted.params.size(), size_t(CameraModelParamCount(model)));
    for (const double x : {5.0, 300.0, 635.0}) {
      for (const double y : {5.0, 240.0, 475.0}) {
        const auto uv = Lens(simple).CameraFromImage({x, y});
        const auto px = Lens(converted).ImageFromCamera(*uv);
        ASSERT_TRUE(px);
        EXPECT_LT((*px - Eigen::Vector2d(x, y)).norm(), tolerance_px) << CameraModelName(model) << x << " " << y;
      }
    }
  }
}

TEST(LensChoice, FieldsOfViewAreBetweenTheCorners) {
  EXPECT_NEAR(FieldOfView_deg(Camera(CameraModel::kSimplePinhole, {400, 320, 240})), 90, 1e-9);  // 400 px to a corner
  EXPECT_NEAR(FieldOfView_deg(Camera(CameraModel::kOpenCVFisheye, {400, 400, 320, 240, 0, 0, 0, 0})), 2 * 180 / M_PI,
              1e-6);
}

// A ray tracer's pixel is where COLMAP's model of the lens has its ray.
TEST(MadeCaptures, RaysAreThoseOfTheLensInTheirTruth) {
  for (const auto& [distortion, model] : {std::pair(Distortion{}, CameraModel::kOpenCV),
                                          {Distortion{false, {-0.16, 0.22, 0.001, -0.0015}}, CameraModel::kOpenCV},
                                          {Distortion{false, {-0.25, 0.06, 0.0005, -0.0005}}, CameraModel::kOpenCV},
                                          {Distortion{true, {-0.02, 0.004, -0.001, 0}}, CameraModel::kOpenCVFisheye}}) {
    nrff::Camera camera;
    camera.width = 640;
    camera.height = 480;
    camera.focal_px = 310;
    camera.distortion = distortion;
    const auto& k = distortion.k;
    const Lens lens({1, model, 640, 480, {310, 310, 320, 240, k[0], k[1], k[2], k[3]}});
    for (const double x : {0.5, 100.0, 320.0, 500.0, 639.5}) {
      for (const double y : {0.5, 200.0, 240.0, 479.5}) {
        const Eigen::Vector3d ray = camera.RayThrough(x, y).direction;
        EXPECT_NEAR(ray.norm(), 1, 1e-12);
        const auto px = lens.ImageFromCamera(ray.hnormalized());
        ASSERT_TRUE(px) << x << " " << y;
        EXPECT_LT((*px - Eigen::Vector2d(x, y)).norm(), 1e-8) << x << " " << y;
      }
    }
  }
}

}  // namespace
}  // namespace nrff
