// How the cameras' corrections are found: every camera is moved so that what the model shows through it agrees with its
// photo [direct image alignment, Engel18], over all training views at once.
#pragma once

#include <torch/types.h>

#include <cstdint>
#include <functional>
#include <vector>

#include "model/camera_corrections.h"
#include "model/ray_batch.h"
#include "render/image_renderer.h"

namespace nrff {

inline constexpr int kTournament = 8;

struct CameraUpdate {
  CameraCorrections corrections;        // in total
  std::vector<double> displacement_px;  // by training view: root mean square motion of its picture by them
};

// Rays as an image one pixel high, each in the exposure of its view; view [n] int32, index of training views.
using RenderTrainingRays = std::function<RenderedImage(const Rays& rays, const torch::Tensor& view)>;

// One Gauss-Newton step from `so_far`. `given`: the training views as the scene has them; `pixels` has them corrected
// by so_far. Pixels are looked at from the stream (seed, kCameraPixels at counter): of every kTournament
// that are drawn the one about which the photo changes most, since the others say little about the camera.
//
// Residuals are the colours' differences, with Huber's weights by their median size; their derivatives by a pixel's
// place are central differences over a pixel of what the model shows, and its motion is that of the point at the depth
// that the model shows. Corrections are normally distributed about none, so that what the photos leave open stays as it
// was, and what all poses have in common, a similarity of the world, is taken out: the held-out views' cameras, which
// nothing is corrected by, stay right. Of the step so much as `gain` is made: less than 1 averages what several looks,
// each at other pixels, say.
struct CameraLook {
  int n_pixels = 200;  // of each view
  double gain = 1;
  uint64_t seed = 0, counter = 0;
};
CameraUpdate UpdateCameras(const PixelSource& pixels, const std::vector<View>& given, const CameraCorrections& so_far,
                           const RenderTrainingRays& render, const CameraLook& look);

// What the corrections have in common, the similarity of the world that explains most of them, to first order.
// `distance`, scene units: a turn counts as much as the shift that looks like it so far away.
void TakeOutCommonMotion(const std::vector<View>& given, double distance, std::vector<PoseCorrection>& poses);

}  // namespace nrff
