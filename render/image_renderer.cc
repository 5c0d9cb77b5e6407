#include "render/image_renderer.h"

#include <omp.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <memory>

#include "render/kernels/camera_rays.h"
#include "render/ray_block.h"
#include "render/ray_quadrature.h"

namespace nrff {
namespace {

constexpr int kTileSide = 8;  // pixels: neighbouring rays meet the same cells
static_assert(kTileSide * kTileSide == RayBlock::kRays);

// What one thread needs to render a block of rays.
class BlockRenderer {
 public:
  BlockRenderer(const RadianceField& field, const OccupancyGrid& occupancy, const SceneMap& map,
                const RenderOptions& options)
      : field_(field), shader_(field.MakeShader(options.precision)), options_(options) {
    args_.occupancy = occupancy.bits();
    args_.map = map;
    args_.step = options.step;
    args_.near = options.near;
    args_.far = options.far;
  }

  // Of n ≤ RayBlock::kRays rays; pixel(r) is ray r's place in the image, which gets Σ w t and Σ w n as they come.
  template <typename Pixel>
  void Render(const float* origins, const float* directions, int64_t n, const Pixel& pixel, RenderedImage& image) {
    args_.origins = origins;
    args_.directions = directions;
    args_.n_rays = n;
    // What a ray has not met when it ends weighs no more than this.
    const double stop = std::max(options_.stop_transmittance, 0.5 * options_.colour_tolerance);
    block_.Trace(field_, args_, 0, n, static_cast<float>(stop));
    const auto tolerance = static_cast<float>(options_.colour_tolerance);
    block_.Select(static_cast<float>(options_.weight_threshold), tolerance);
    quadrature_.Integrate(block_, directions, args_.step, tolerance, *shader_);
    n_samples += block_.n_evaluated;
    n_shaded += quadrature_.n_shaded;
    for (int64_t r = 0; r < n; ++r) Composite(r, pixel(r), image);
  }

  int64_t n_samples = 0, n_shaded = 0;

 private:
  void Composite(int64_t r, int64_t pixel, RenderedImage& image) const {
    const float behind = block_.transmittance[r];
    float depth = 0, shaded = 0;
    for (int64_t i = block_.shaded_offsets[r]; i < block_.shaded_offsets[r + 1]; ++i) {
      shaded += block_.weights[block_.shaded[i]];
    }
    for (int64_t i = block_.offsets[r]; i < block_.offsets[r + 1]; ++i) depth += block_.weights[i] * block_.t[i];
    const float with_unshaded = shaded > 0 ? 1 + block_.unshaded[r] / shaded : 1;
    for (int c = 0; c < 3; ++c) {
      image.rgb[3 * pixel + c] =
          with_unshaded * quadrature_.rgb[3 * r + c] + behind * static_cast<float>(options_.background);
      image.normal[3 * pixel + c] = quadrature_.normals[3 * r + c];
    }
    image.depth[pixel] = depth;
    image.opacity[pixel] = 1 - behind;
  }

  const RadianceField& field_;
  std::unique_ptr<RadianceField::Shader> shader_;
  const RenderOptions& options_;
  MarchArgs<float> args_;
  RayBlock block_;
  RayQuadrature quadrature_;
};

// The image's pixels in squares, whose rays lie side by side.
class TileRenderer {
 public:
  TileRenderer(BlockRenderer& block, const View& view)
      : block_(block), view_(view), camera_{view.fx, view.fy, view.cx, view.cy, {}} {
    std::copy_n(view.scene_from_camera.begin(), 12, camera_.scene_from_camera);
  }

  void Render(int tile_x, int tile_y, RenderedImage& image) {
    const int x_end = std::min(view_.width, (tile_x + 1) * kTileSide);
    const int y_end = std::min(view_.height, (tile_y + 1) * kTileSide);
    int64_t n = 0;
    for (int y = tile_y * kTileSide; y < y_end; ++y) {
      for (int x = tile_x * kTileSide; x < x_end; ++x, ++n) {
        pixels_[3 * n] = 0;
        pixels_[3 * n + 1] = x;
        pixels_[3 * n + 2] = y;
      }
    }
    CameraRaysCpu(CameraRaysArgs<float>{
        .n_rays = n, .cameras = &camera_, .pixels = pixels_, .origins = origins_, .directions = directions_});
    const auto place = [&](int64_t r) { return int64_t{pixels_[3 * r + 2]} * view_.width + pixels_[3 * r + 1]; };
    block_.Render(origins_, directions_, n, place, image);
  }

 private:
  BlockRenderer& block_;
  const View& view_;
  PinholeCamera camera_;
  int32_t pixels_[3 * RayBlock::kRays];
  float origins_[3 * RayBlock::kRays], directions_[3 * RayBlock::kRays];
};

RenderedImage EmptyImage(int width, int height) {
  const auto n = size_t(width) * size_t(height);
  RenderedImage image;
  image.width = width;
  image.height = height;
  image.rgb.resize(3 * n);
  image.depth.resize(n);
  image.normal.resize(3 * n);
  image.opacity.resize(n);
  return image;
}

// do_part(renderer, part, image) for each of the parts, on all cores.
template <typename Part>
void RenderParts(const RadianceField& field, const OccupancyGrid& occupancy, const SceneMap& map,
                 const RenderOptions& options, int n_parts, const Part& do_part, RenderedImage& image) {
#pragma omp parallel
  {
    BlockRenderer renderer(field, occupancy, map, options);
#pragma omp for schedule(dynamic, 4)
    for (int part = 0; part < n_parts; ++part) do_part(renderer, part, image);
#pragma omp critical
    {
      image.n_samples += renderer.n_samples;
      image.n_shaded += renderer.n_shaded;
    }
  }
  NormaliseGeometry(image);
}

}  // namespace

void NormaliseGeometry(RenderedImage& image) {
  for (size_t i = 0; i < image.opacity.size(); ++i) {
    // Where less than half the light is stopped, there is no surface.
    image.depth[i] = image.opacity[i] < 0.5F ? 0.F : image.depth[i] / image.opacity[i];
    // Σ w n is shorter than the opacity where normals within a ray disagree; its direction is what is wanted.
    float* n = &image.normal[3 * i];
    const float norm = std::sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
    const float scale = norm > 0 ? image.opacity[i] / norm : 0.F;
    for (int k = 0; k < 3; ++k) n[k] *= scale;
  }
}

RenderOptions PictureOptions(RenderOptions trained, int bits) {
  constexpr double kSixteenBitStep = 1.0 / 65535;
  const bool eight = bits == 8;
  trained.colour_tolerance = eight ? kEightBitTolerance : 0;
  trained.precision = eight ? ShadingPrecision::kBf16 : ShadingPrecision::kFloat;
  trained.weight_threshold = eight ? 0 : kSixteenBitStep;
  trained.stop_transmittance = kSixteenBitStep;  // with 8 bits the tolerance ends rays before
  return trained;
}

RenderedImage RenderImage(const RadianceField& field, const OccupancyGrid& occupancy, const SceneMap& map,
                          const View& view, const RenderOptions& options, const TileProgress& progress) {
  CheckOptions(options);
  const int64_t n_rays = int64_t{view.width} * view.height;
  RenderedImage image = EmptyImage(view.width, view.height);
  const int n_columns = (view.width + kTileSide - 1) / kTileSide, n_rows = (view.height + kTileSide - 1) / kTileSide;
  const int n_tiles = n_columns * n_rows;
  std::atomic<int> n_done = 0;
  const auto render_tile = [&](BlockRenderer& renderer, int tile, RenderedImage& into) {
    TileRenderer(renderer, view).Render(tile % n_columns, tile / n_columns, into);
    ++n_done;
    if (progress && omp_get_thread_num() == 0) progress(n_rays * n_done / n_tiles);
  };
  RenderParts(field, occupancy, map, options, n_tiles, render_tile, image);
  if (progress) progress(n_rays);
  return image;
}

RenderedImage RenderRayImage(const RadianceField& field, const OccupancyGrid& occupancy, const SceneMap& map,
                             const Rays& rays, const RenderOptions& options) {
  CheckOptions(options);
  const torch::Tensor origins = rays.origins.contiguous(), directions = rays.directions.contiguous();
  const int64_t n_rays = origins.size(0);
  RenderedImage image = EmptyImage(int(n_rays), 1);
  const auto render_block = [&](BlockRenderer& renderer, int block, RenderedImage& into) {
    const int64_t first = block * RayBlock::kRays;
    renderer.Render(
        origins.const_data_ptr<float>() + 3 * first, directions.const_data_ptr<float>() + 3 * first,
        std::min(RayBlock::kRays, n_rays - first), [&](int64_t r) { return first + r; }, into);
  };
  RenderParts(field, occupancy, map, options, int((n_rays + RayBlock::kRays - 1) / RayBlock::kRays), render_block,
              image);
  return image;
}

}  // namespace nrff
