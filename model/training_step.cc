#include "model/training_step.h"

#include <ATen/ATen.h>
#include <omp.h>

#include <algorithm>
#include <cmath>

#include "model/kernels/tile_rows.h"
#include "render/kernels/colour_correction.h"
#include "render/kernels/compositing.h"
#include "render/kernels/compositing_ray.h"
#include "render/kernels/random.h"

namespace nrff {
namespace {

using torch::Tensor;

constexpr int64_t kTileSamples = 224;  // shaded together: enough to pay for a layer's set-up, few enough for the cache

MarchArgs<float> March(const Rays& rays, const OccupancyGrid& occupancy, const SceneMap& map,
                       const RenderOptions& options, RandomStream jitter_purpose) {
  MarchArgs<float> args{.n_rays = rays.origins.size(0),
                        .origins = rays.origins.const_data_ptr<float>(),
                        .directions = rays.directions.const_data_ptr<float>(),
                        .occupancy = occupancy.bits(),
                        .map = map,
                        .step = options.step,
                        .near = options.near,
                        .far = options.far};
  if (options.jitter) {
    args.jitter = true;
    args.jitter_seed = options.jitter->first;
    args.jitter_stream = StreamAt(jitter_purpose, options.jitter->second);
  }
  return args;
}

int64_t BlocksOf(int64_t n_rays) { return (n_rays + RayBlock::kRays - 1) / RayBlock::kRays; }

}  // namespace

// What all threads read.
struct TrainingStep::Batch {
  const PixelSource::Batch& pixels;
  const DepthSource::Batch* depths;
  MarchArgs<float> march, depth_march;
  RenderOptions options;
  LossWeights weights;
  int64_t n_rays = 0, n_depths = 0, n_shaded = 0;

  int64_t first_ray(int block) const {
    const int64_t n_colour_blocks = BlocksOf(n_rays);
    return RayBlock::kRays * (block < n_colour_blocks ? block : block - n_colour_blocks);
  }
};

TrainingStep::TrainingStep(const NrffField& field) : field_(field), networks_(field.Networks()) {
  for (const NrffField::Parameter& parameter : field.parameters()) {
    gradients_.push_back(at::zeros(parameter.value.sizes(), torch::kFloat));
  }
  const GridLayout &density = field.density_layout(), &appearance = field.appearance_layout();
  const int n_density = density.n_products();
  for (int task = 0; task < n_density + appearance.n_products(); ++task) scatter_tasks_.push_back(task);
  const auto cost = [&](int task) {
    const GridLayout& layout = task < n_density ? density : appearance;
    return layout.n_channels * layout.levels[(task < n_density ? task : task - n_density) / 3].resolution;
  };
  std::stable_sort(scatter_tasks_.begin(), scatter_tasks_.end(), [&](int a, int b) { return cost(a) > cost(b); });
}

TrainingStep::Result TrainingStep::Run(const PixelSource::Batch& pixels, const DepthSource::Batch* depths,
                                       const OccupancyGrid& occupancy, const SceneMap& map,
                                       const RenderOptions& options, const LossWeights& weights) {
  CheckOptions(options);
  Batch batch{
      .pixels = pixels, .depths = depths, .march = {}, .depth_march = {}, .options = options, .weights = weights};
  batch.march = March(pixels.rays, occupancy, map, options, RandomStream::kRayJitter);
  batch.n_rays = batch.march.n_rays;
  if (depths != nullptr) {
    batch.depth_march = March(depths->rays, occupancy, map, options, RandomStream::kDepthJitter);
    batch.n_depths = batch.depth_march.n_rays;
  }
  const int64_t n_colour_blocks = BlocksOf(batch.n_rays), n_blocks = n_colour_blocks + BlocksOf(batch.n_depths);
  if (int64_t(blocks_.size()) < n_blocks) blocks_.resize(n_blocks);
  while (int(threads_.size()) < omp_get_max_threads()) threads_.push_back(std::make_unique<Thread>(networks_));
  Result result;
  packed_.Pack(networks_, /*backward=*/true);

#pragma omp parallel
  {
    Thread& thread = *threads_[omp_get_thread_num()];
    thread.gradients.Clear();
    thread.d_corrections.assign(size_t(kCorrectionParameters) * field_.config().corrected_views, 0.F);
    thread.mse = thread.orientation = thread.sparsity = thread.depth = 0;
#pragma omp for schedule(dynamic, 1)
    for (int64_t b = 0; b < n_blocks; ++b) {
      const MarchArgs<float>& march = b < n_colour_blocks ? batch.march : batch.depth_march;
      const int64_t first = batch.first_ray(int(b));
      blocks_[b].Trace(field_, march, first, std::min(RayBlock::kRays, march.n_rays - first),
                       float(options.stop_transmittance));
      if (b < n_colour_blocks) blocks_[b].Select(float(options.weight_threshold));
    }
#pragma omp single
    {
      n_team_ = omp_get_num_threads();
      for (int64_t b = 0; b < n_blocks; ++b) {
        result.n_samples += blocks_[b].n_evaluated;
        if (b < n_colour_blocks) result.n_shaded += int64_t(blocks_[b].shaded.size());
      }
      batch.n_shaded = result.n_shaded;
      n_tiles_ = 0;
      MakeTiles(n_colour_blocks);
      for (int64_t b = n_colour_blocks; b < n_blocks; ++b) {
        if (n_tiles_ == int64_t(tiles_.size())) tiles_.emplace_back();
        Tile& tile = tiles_[n_tiles_++];
        tile.block = int(b);
        tile.first_ray = 0;
        tile.end_ray = blocks_[b].n_rays;
        tile.depth = true;
      }
    }
#pragma omp for schedule(dynamic, 1)
    for (int64_t i = 0; i < n_tiles_; ++i) {
      if (tiles_[i].depth) {
        MatchDepths(batch, tiles_[i], thread);
      } else {
        ShadeTile(batch, tiles_[i], thread);
      }
    }
#pragma omp for schedule(dynamic, 1)
    for (size_t i = 0; i < scatter_tasks_.size(); ++i) Scatter(scatter_tasks_[i], weights.density_l1);
  }
  ReduceNetworks();
  if (field_.config().corrected_views > 0) ReduceCorrections(weights.correction);
  for (int i = 0; i < n_team_; ++i) {
    const Thread* thread = threads_[i].get();
    result.mse += thread->mse;
    result.orientation += thread->orientation;
    result.sparsity += thread->sparsity;
    result.depth += thread->depth;
  }
  return result;
}

void TrainingStep::MakeTiles(int64_t n_colour_blocks) {
  for (int64_t b = 0; b < n_colour_blocks; ++b) {
    const RayBlock& block = blocks_[b];
    const auto n_shaded = int64_t(block.shaded.size());
    const int64_t n_parts = std::max<int64_t>(1, (n_shaded + kTileSamples - 1) / kTileSamples);
    int64_t ray = 0;
    for (int64_t part = 0; part < n_parts && ray < block.n_rays; ++part) {
      // Rays are not cut, so a part may be larger than its share.
      const int64_t end_sample = n_shaded * (part + 1) / n_parts;
      int64_t end_ray = ray + 1;
      while (end_ray < block.n_rays && block.shaded_offsets[end_ray + 1] <= end_sample) ++end_ray;
      if (part + 1 == n_parts) end_ray = block.n_rays;
      if (n_tiles_ == int64_t(tiles_.size())) tiles_.emplace_back();
      Tile& tile = tiles_[n_tiles_++];
      tile.block = int(b);
      tile.first_ray = ray;
      tile.end_ray = end_ray;
      tile.depth = false;
      ray = end_ray;
    }
  }
}

void TrainingStep::ShadeTile(const Batch& batch, Tile& tile, Thread& thread) {
  const RayBlock& block = blocks_[tile.block];
  const GridLayout& layout = field_.appearance_layout();
  const int64_t begin = block.shaded_offsets[tile.first_ray];
  const int64_t n = block.shaded_offsets[tile.end_ray] - begin;
  const float* directions = batch.march.directions + 3 * batch.first_ray(tile.block);
  tile.points.resize(3 * n);
  tile.d_features.resize(n * layout.n_features());
  thread.directions.resize(3 * n);
  for (int64_t r = tile.first_ray; r < tile.end_ray; ++r) {
    for (int64_t i = block.shaded_offsets[r]; i < block.shaded_offsets[r + 1]; ++i) {
      std::copy_n(&block.points[3 * block.shaded[i]], 3, &tile.points[3 * (i - begin)]);
      std::copy_n(directions + 3 * r, 3, &thread.directions[3 * (i - begin)]);
    }
  }
  ShadingTile& shading = thread.tile;
  shading.Reserve(std::max(n, kTileSamples));
  const int64_t stride = shading.stride();
  if (n > 0) {
    thread.features.resize(n * layout.n_features());
    GridConcatForward(layout, field_.appearance_parameters(), tile.points.data(), n, thread.features.data());
    ProductsToRows(thread.features.data(), layout, n, stride, shading.features());
    PointsToRows(thread.directions.data(), n, stride, shading.ray_directions());
    shading.Forward(networks_, n);
  }
  Composite(batch, tile, thread);
  if (n > 0) {
    shading.Backward(networks_, n, thread.gradients);
    RowsToProducts(shading.d_features(), layout, n, stride, tile.d_features.data());
  }
  BackwardDensity(batch, tile, thread);
}

// Colours of the tile's rays, what is wrong with them, and what that asks of the samples' colours, normals and weights
// and of the transmittance to the background.
void TrainingStep::Composite(const Batch& batch, const Tile& tile, Thread& thread) {
  const RayBlock& block = blocks_[tile.block];
  const int64_t begin = block.shaded_offsets[tile.first_ray], n = block.shaded_offsets[tile.end_ray] - begin;
  ShadingTile& shading = thread.tile;
  const int64_t stride = shading.stride();
  const float *rgb = shading.rgb(), *normals = shading.normals(), *directions = shading.ray_directions();
  float *d_rgb = shading.d_rgb(), *d_normals = shading.d_normals();
  const float* target = batch.pixels.target.const_data_ptr<float>() + 3 * batch.first_ray(tile.block);
  const auto background = float(batch.options.background);
  const float* corrections =
      field_.config().corrected_views > 0 ? field_.colour_corrections().const_data_ptr<float>() : nullptr;
  const int32_t* views =
      corrections == nullptr ? nullptr : batch.pixels.view.const_data_ptr<int32_t>() + batch.first_ray(tile.block);
  const auto mse_scale = float(2 / (3 * double(batch.n_rays)));
  const double per_shaded = 1 / double(std::max<int64_t>(batch.n_shaded, 1));
  const auto orientation_scale = float(batch.weights.orientation * per_shaded);

  thread.d_weights.assign(block.t.size(), 0.F);
  thread.d_transmittance.assign(block.n_rays, 0.F);
  for (int c = 0; c < 3; ++c) {
    const int64_t padded = std::min(stride, n + ShadingTile::kSamplesMultiple);
    std::fill(d_rgb + c * stride + n, d_rgb + c * stride + padded, 0.F);
    std::fill(d_normals + c * stride + n, d_normals + c * stride + padded, 0.F);
  }
  for (int64_t r = tile.first_ray; r < tile.end_ray; ++r) {
    const int64_t ray_begin = block.shaded_offsets[r] - begin, ray_end = block.shaded_offsets[r + 1] - begin;
    const float transmittance = block.transmittance[r];
    const int64_t view = corrections == nullptr ? 0 : views[r];
    const float* correction = corrections == nullptr ? nullptr : corrections + kCorrectionParameters * view;
    float light[3], colour[3], d_colour[3], d_light[3];
    for (int c = 0; c < 3; ++c) {
      light[c] = 0;
      for (int64_t i = ray_begin; i < ray_end; ++i) {
        light[c] += block.weights[block.shaded[begin + i]] * rgb[c * stride + i];
      }
    }
    CorrectedColour(correction, light, transmittance, background, colour);
    for (int c = 0; c < 3; ++c) {
      const float error = colour[c] - target[3 * r + c];
      thread.mse += double(error) * error / (3 * double(batch.n_rays));
      d_colour[c] = mse_scale * error;
    }
    thread.d_transmittance[r] =
        CorrectedColourBackward(correction, light, transmittance, background, d_colour, d_light,
                                [&](int i, float d) { thread.d_corrections[kCorrectionParameters * view + i] += d; });
    for (int64_t i = ray_begin; i < ray_end; ++i) {
      const int64_t sample = block.shaded[begin + i];
      const float weight = block.weights[sample];
      float d_weight = 0, facing_away = 0;
      for (int c = 0; c < 3; ++c) {
        d_weight += d_light[c] * rgb[c * stride + i];
        d_rgb[c * stride + i] = weight * d_light[c];
        facing_away += normals[c * stride + i] * directions[c * stride + i];
      }
      facing_away = std::max(facing_away, 0.F);
      thread.orientation += double(weight) * facing_away * facing_away * per_shaded;
      d_weight += orientation_scale * facing_away * facing_away;
      const float d_facing = 2 * orientation_scale * weight * facing_away;
      for (int c = 0; c < 3; ++c) d_normals[c * stride + i] = d_facing * directions[c * stride + i];
      thread.d_weights[sample] = d_weight;
    }
  }
}

void TrainingStep::MatchDepths(const Batch& batch, Tile& tile, Thread& thread) {
  const RayBlock& block = blocks_[tile.block];
  tile.points.clear();
  tile.d_features.clear();
  const int64_t first = batch.first_ray(tile.block);
  const float* distance = batch.depths->distance.const_data_ptr<float>() + first;
  const float* spread = batch.depths->spread.const_data_ptr<float>() + first;
  const double per_ray = 1 / double(batch.n_depths);
  const auto scale = float(batch.weights.depth * per_ray);
  thread.d_weights.assign(block.t.size(), 0.F);
  thread.d_transmittance.assign(block.n_rays, 0.F);
  for (int64_t r = 0; r < block.n_rays; ++r) {
    double matched = 0;
    for (int64_t i = block.offsets[r]; i < block.offsets[r + 1]; ++i) {
      const float off = (block.t[i] - distance[r]) / spread[r];
      const float match = std::exp(-0.5F * off * off);
      matched += double(block.weights[i]) * match;
      thread.d_weights[i] = -scale * match;
    }
    thread.depth += (1 - matched) * per_ray;
  }
  BackwardDensity(batch, tile, thread);
}

// dL/dw and dL/dT_end → dL/df of the tile's samples, where there is any.
void TrainingStep::BackwardDensity(const Batch& batch, Tile& tile, Thread& thread) {
  const RayBlock& block = blocks_[tile.block];
  const int64_t begin = block.offsets[tile.first_ray], end = block.offsets[tile.end_ray];
  thread.d_sigma.resize(block.t.size());
  const WeightsBackwardArgs<float> args{.n_rays = block.n_rays,
                                        .ray_offsets = block.offsets.data(),
                                        .delta = block.delta.data(),
                                        .weights = block.weights.data(),
                                        .transmittance = block.transmittance.data(),
                                        .n_reached = block.n_reached.data(),
                                        .dL_dweights = thread.d_weights.data(),
                                        .dL_dtransmittance = thread.d_transmittance.data(),
                                        .dL_dsigma = thread.d_sigma.data()};
  for (int64_t r = tile.first_ray; r < tile.end_ray; ++r) WeightsBackwardRay(args, r);
  if (!tile.depth && batch.weights.sparsity > 0) {
    const double per_ray = 1 / double(batch.n_rays);
    const auto scale = float(batch.weights.sparsity * per_ray);
    for (int64_t i = begin; i < end; ++i) {
      const float opacity = -std::expm1(-block.sigma[i] * block.delta[i]);
      thread.sparsity += double(opacity) * per_ray;
      thread.d_sigma[i] += scale * block.delta[i] * (1 - opacity);
    }
  }
  DensityGradients(float(field_.config().density_scale), block.sigma.data() + begin, end - begin,
                   thread.d_sigma.data() + begin);
  tile.density_points.clear();
  tile.d_density.clear();
  for (int64_t i = begin; i < end; ++i) {
    if (thread.d_sigma[i] == 0) continue;
    tile.d_density.push_back(thread.d_sigma[i]);
    tile.density_points.insert(tile.density_points.end(), &block.points[3 * i], &block.points[3 * i] + 3);
  }
}

// All that the step leaves in one product's plane and line, starting from the L1 term or nothing.
void TrainingStep::Scatter(int task, double density_l1) {
  const int n_density = field_.density_layout().n_products();
  const bool appearance = task >= n_density;
  const GridLayout& layout = appearance ? field_.appearance_layout() : field_.density_layout();
  const float* parameters = appearance ? field_.appearance_parameters() : field_.density_parameters();
  auto* gradient = gradients_[appearance ? 1 : 0].mutable_data_ptr<float>();
  const int product = appearance ? task - n_density : task;
  const GridLayout::Level& level = layout.levels[product / 3];
  const int64_t n_line = int64_t(level.resolution) * layout.n_channels;
  const std::pair<int64_t, int64_t> parts[2] = {{level.plane_offsets[product % 3], n_line * level.resolution},
                                                {level.line_offsets[product % 3], n_line}};
  for (const auto& [offset, n] : parts) {
    if (appearance || density_l1 == 0) {
      std::fill_n(gradient + offset, n, 0.F);
    } else {
      const auto rate = float(density_l1 / (double(n) * 2 * n_density));
      for (int64_t i = offset; i < offset + n; ++i) {
        gradient[i] = parameters[i] > 0 ? rate : parameters[i] < 0 ? -rate : 0.F;
      }
    }
  }
  for (int64_t i = 0; i < n_tiles_; ++i) {
    const Tile& tile = tiles_[i];
    if (appearance) {
      const auto n = int64_t(tile.points.size()) / 3;
      GridConcatBackward(layout, product, parameters, tile.points.data(), n,
                         tile.d_features.data() + product * n * layout.n_channels, gradient);
    } else {
      GridSumBackward(layout, product, parameters, tile.density_points.data(), int64_t(tile.d_density.size()),
                      tile.d_density.data(), gradient);
    }
  }
}

void TrainingStep::ReduceCorrections(double weight) {
  const Tensor& corrections = field_.colour_corrections();
  Tensor& gradient = gradients_.back();
  const auto rate = float(2 * weight / double(corrections.size(0)));
  const auto* from = corrections.const_data_ptr<float>();
  auto* to = gradient.mutable_data_ptr<float>();
  for (int64_t i = 0; i < gradient.numel(); ++i) {
    to[i] = rate * from[i];
    for (int thread = 0; thread < n_team_; ++thread) to[i] += threads_[thread]->d_corrections[i];
  }
}

void TrainingStep::ReduceNetworks() {
  constexpr int kGrids = 2;
  const size_t n_layers = threads_.front()->gradients.layers().size();
#pragma omp parallel for schedule(dynamic, 1)
  for (size_t l = 0; l < n_layers; ++l) {
    Tensor &weight = gradients_[kGrids + 2 * l], &bias = gradients_[kGrids + 2 * l + 1];
    const int64_t n_out = weight.size(0), n_in = weight.size(1);
    auto *to_weight = weight.mutable_data_ptr<float>(), *to_bias = bias.mutable_data_ptr<float>();
    std::fill_n(to_weight, n_out * n_in, 0.F);
    std::fill_n(to_bias, n_out, 0.F);
    for (int i = 0; i < n_team_; ++i) {
      const ShadingGradients::Layer& from = threads_[i]->gradients.layers()[l];
      for (int64_t r = 0; r < n_out; ++r) {
        for (int64_t k = 0; k < n_in; ++k) to_weight[r * n_in + k] += from.weight[r * from.stride + k];
        to_bias[r] += from.bias[r];
      }
    }
  }
}

}  // namespace nrff
