#include "sfm/sensor_frame.h"

#include <cmath>
#include <utility>
#include <vector>

#include "sfm/lens_model.h"

namespace nrff {
namespace {

// (p1, p2) or (sx1, sy1): displayed (u, v) is (−v, u), and so are the displacements that these are factors of.
void TurnTangential(double& p1, double& p2) { p1 = std::exchange(p2, -p1); }
void TurnThinPrism(double& sx, double& sy) { sx = -std::exchange(sy, sx); }

ColmapCamera TurnedOnce(ColmapCamera camera) {
  std::swap(camera.width, camera.height);
  std::vector<double>& params = camera.params;
  const auto distortion = size_t(lens_model::FirstDistortion(camera.model));
  if (!lens_model::HasOneFocalLength(camera.model)) std::swap(params[0], params[1]);
  double &cx = params[distortion - 2], &cy = params[distortion - 1];
  cx = camera.width - std::exchange(cy, cx);
  const bool tangential = camera.model == CameraModel::kOpenCV || camera.model == CameraModel::kFullOpenCV ||
                          camera.model == CameraModel::kThinPrismFisheye;
  if (tangential) TurnTangential(params[distortion + 2], params[distortion + 3]);
  if (camera.model == CameraModel::kThinPrismFisheye) TurnThinPrism(params[distortion + 6], params[distortion + 7]);
  return camera;
}

}  // namespace

int QuarterTurns(int orientation) {
  switch (orientation) {
    case 3:
      return 2;
    case 6:
      return 1;
    case 8:
      return 3;
    default:
      return 0;
  }
}

std::pair<int, int> SensorSize(const ImageInfo& photo) {
  return QuarterTurns(photo.orientation) % 2 == 0 ? std::pair(photo.width, photo.height)
                                                  : std::pair(photo.height, photo.width);
}

Image AsSensorHadIt(Image displayed, int orientation) {
  constexpr int kOrientationOfTurns[] = {1, 6, 3, 8};
  return Oriented(std::move(displayed), kOrientationOfTurns[(4 - QuarterTurns(orientation)) % 4]);
}

ColmapCamera TurnedCamera(ColmapCamera camera, int quarter_turns) {
  for (int i = 0; i < quarter_turns; ++i) camera = TurnedOnce(std::move(camera));
  return camera;
}

void TurnImage(ColmapImage& image, int width, int height, int quarter_turns) {
  const Eigen::Quaterniond once(std::sqrt(0.5), 0, 0, std::sqrt(0.5));  // (x, y) → (−y, x)
  for (int i = 0; i < quarter_turns; ++i) {
    image.rotation = (once * image.rotation).normalized();
    image.translation = once * image.translation;
    for (ColmapObservation& observation : image.observations)
      observation.x = height - std::exchange(observation.y, observation.x);
    std::swap(width, height);
  }
}

}  // namespace nrff
