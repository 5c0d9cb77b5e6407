#include "render/image_renderer.h"

#include <ATen/ATen.h>
#include <c10/core/GradMode.h>

#include <algorithm>
#include <cmath>

namespace nrff {
namespace {

// Rays per tile: enough to keep every core busy, few enough for the samples' features to stay small.
constexpr int64_t kTileRays = 8192;

// [first, first + n) of the view's pixels in row-major order, as RaysThroughPixels takes them.
torch::Tensor TilePixels(const View& view, int64_t first, int64_t n) {
  torch::Tensor pixels = at::empty({n, 3}, at::kInt);
  auto* data = pixels.mutable_data_ptr<int32_t>();
  for (int64_t i = 0; i < n; ++i) {
    data[3 * i] = 0;
    data[3 * i + 1] = static_cast<int32_t>((first + i) % view.width);
    data[3 * i + 2] = static_cast<int32_t>((first + i) / view.width);
  }
  return pixels;
}

void Append(std::vector<float>& image, const torch::Tensor& tile) {
  const torch::Tensor values = tile.contiguous();
  const float* data = values.const_data_ptr<float>();
  image.insert(image.end(), data, data + values.numel());
}

// Σ w t is the expected distance times the opacity; where less than half the light is stopped, there is no surface.
void NormaliseDepth(RenderedImage& image) {
  for (size_t i = 0; i < image.depth.size(); ++i) {
    image.depth[i] = image.opacity[i] < 0.5F ? 0.F : image.depth[i] / image.opacity[i];
  }
}

// Σ w n is shorter than the opacity where normals within a ray disagree; its direction is what is wanted.
void NormaliseNormals(RenderedImage& image) {
  for (size_t i = 0; i < image.opacity.size(); ++i) {
    float* n = &image.normal[3 * i];
    const float norm = std::sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
    const float scale = norm > 0 ? image.opacity[i] / norm : 0.F;
    for (int k = 0; k < 3; ++k) n[k] *= scale;
  }
}

}  // namespace

RenderedImage RenderImage(const RadianceField& field, const OccupancyGrid& occupancy, const SceneMap& map,
                          const View& view, const RenderOptions& options, const TileProgress& progress) {
  const c10::NoGradGuard no_grad;
  const std::vector<View> views{view};
  const int64_t n_rays = int64_t{view.width} * view.height;
  RenderedImage image;
  image.width = view.width;
  image.height = view.height;
  image.rgb.reserve(3 * n_rays);
  image.depth.reserve(n_rays);
  image.normal.reserve(3 * n_rays);
  image.opacity.reserve(n_rays);
  for (int64_t first = 0; first < n_rays; first += kTileRays) {
    const int64_t n = std::min(kTileRays, n_rays - first);
    const Rays rays = RaysThroughPixels(views, TilePixels(view, first, n), torch::kFloat);
    const RenderResult tile = RenderRays(field, occupancy, map, rays, options);
    Append(image.rgb, tile.rgb);
    Append(image.depth, tile.depth);
    Append(image.normal, tile.normal);
    Append(image.opacity, tile.opacity);
    image.n_samples += tile.n_samples;
    image.n_shaded += tile.n_shaded;
    if (progress) progress(first + n);
  }
  NormaliseDepth(image);
  NormaliseNormals(image);
  return image;
}

}  // namespace nrff
