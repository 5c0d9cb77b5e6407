// Whole images of a model: a pinhole view rendered in tiles of rays, without gradients.
#pragma once

#include <cstdint>
#include <functional>
#include <vector>

#include "pipeline/scene.h"
#include "render/volume_renderer.h"

namespace nrff {

struct RenderedImage {
  int width = 0, height = 0;   // px
  std::vector<float> rgb;      // [height, width, 3] display-referred, in [0, 1] where the field's colours are
  std::vector<float> depth;    // [height, width] expected distance along the ray, scene units; 0 where opacity < ½
  std::vector<float> normal;   // [height, width, 3] scene axes, length = opacity
  std::vector<float> opacity;  // [height, width] in [0, 1]
  int64_t n_samples = 0, n_shaded = 0;  // evaluations of density and of shading
};

// RenderOptions::colour_tolerance of pictures to be written with 8 bits: half a step of theirs.
inline constexpr double kEightBitTolerance = 0.5 / 255;

// Options for pictures to be written with `bits` of 8 or 16. Training's thresholds are too coarse for them: on fox they
// are off by up to 0.09 (weight threshold 0.01 in tests/bench/results/work_precision_fox.md), and under the tolerance
// of 8 bits they saved no time: 0.31 s a view with them, rms error 6.5e-3, 0.27 s and 1.5e-3 without. Products in bf16,
// for 8 bits, move a view of the paper's model (that of tests/bench/step.cc, nearly every sample shaded by itself) by
// 4e-5 root mean square, 0.003 at the most: measured, not bounded.
RenderOptions PictureOptions(RenderOptions trained, int bits);

// depth: Σ w t → the expected distance; normal: Σ w n → its direction, as long as the opacity.
void NormaliseGeometry(RenderedImage& image);

// Called after every tile with the number of rays done so far.
using TileProgress = std::function<void(int64_t n_rays_done)>;

RenderedImage RenderImage(const RadianceField& field, const OccupancyGrid& occupancy, const SceneMap& map,
                          const View& view, const RenderOptions& options, const TileProgress& progress = {});

// Float rays [n, 3] as an image n pixels wide and one high.
RenderedImage RenderRayImage(const RadianceField& field, const OccupancyGrid& occupancy, const SceneMap& map,
                             const Rays& rays, const RenderOptions& options);

}  // namespace nrff
