// Kernels of device_runtime.h that go from random pixels to the samples of their rays and their weights.
//
// Rays 0 … n_rays − 1 have colours, n_rays … n_rays + n_depths − 1 end at known distances. Kernels are queued for as
// many rays and samples as there is room for, and do nothing beyond those that there are.
#pragma once

#include <cmath>
#include <cstdint>

#include "render/kernels/compositing_ray.h"
#include "render/kernels/depth_ray.h"
#include "render/kernels/device_runtime.h"
#include "render/kernels/pixel_ray.h"
#include "render/kernels/ray_marcher.h"
#include "render/kernels/step_control.h"

namespace nrff::device {

NRFF_HOST_DEVICE inline int64_t RaysOf(const StepControl& control) { return control.n_rays + control.n_depths; }

// PixelSource::Draw of model/ray_batch.h, ray by ray.
struct DrawPixels {
  const StepControl* control;
  const GpuView* views;
  const uint64_t* pixels_before;  // [n_views + 1]
  const uint32_t* rows_before;    // of the masked views
  int n_views;
  const uint8_t* pack;
  float *origins, *directions, *target;  // [n_rays, 3]
  int* view_of_ray;                      // [n_rays]

  NRFF_HOST_DEVICE void operator()(int64_t r) const {
    if (r >= control->n_rays) return;
    const uint64_t stream = StreamAt(RandomStream::kBatch, control->step);
    const uint64_t drawn = UniformBelow(pixels_before[n_views], control->seed, stream, static_cast<uint64_t>(r));
    int low = 0, high = n_views;  // pixels_before[low] ≤ drawn < pixels_before[high]
    while (high - low > 1) {
      const int middle = (low + high) / 2;
      (pixels_before[middle] <= drawn ? low : high) = middle;
    }
    const GpuView& view = views[low];
    view_of_ray[r] = low;
    const uint64_t within = drawn - pixels_before[low];
    const uint8_t* pixels = pack + view.pack_offset;
    int ix = static_cast<int>(within % view.width), iy = static_cast<int>(within / view.width);
    if (view.rows_before >= 0) {
      CountingPixel(pixels, rows_before + view.rows_before, view.width, view.height, static_cast<uint32_t>(within), &ix,
                    &iy);
    }
    PixelRay(view.camera, ix, iy, origins + 3 * r, directions + 3 * r);
    PixelColour(pixels + (static_cast<int64_t>(iy) * view.width + ix) * view.n_channels, view.n_channels,
                control->background, target + 3 * r);
  }
};

// Rays through the pixels first, first + 1, … of a view, row by row.
struct DrawView {
  const StepControl* control;
  PinholeCamera camera;
  int width;
  int64_t first;
  float *origins, *directions;  // [n_rays, 3]

  NRFF_HOST_DEVICE void operator()(int64_t r) const {
    if (r >= control->n_rays) return;
    const int64_t pixel = first + r;
    PixelRay(camera, static_cast<int>(pixel % width), static_cast<int>(pixel / width), origins + 3 * r,
             directions + 3 * r);
  }
};

// DepthSource::Draw of model/depth_batch.h, ray by ray.
struct DrawDepths {
  const StepControl* control;
  const DepthTarget* depths;
  uint64_t n;
  float *origins, *directions;  // [n_rays + n_depths, 3]
  float *distance, *spread;     // [n_depths]

  NRFF_HOST_DEVICE void operator()(int64_t i) const {
    if (i >= control->n_depths) return;
    const uint64_t stream = StreamAt(RandomStream::kDepthBatch, control->step);
    const int64_t r = control->n_rays + i;
    DepthRay(depths[UniformBelow(n, control->seed, stream, static_cast<uint64_t>(i))], control->map,
             control->march_step, origins + 3 * r, directions + 3 * r, distance + i, spread + i);
  }
};

// Ray r of the step, colour or depth.
NRFF_HOST_DEVICE inline RayMarcher<float> MarcherOf(const StepControl& control, const OccupancyBits& occupancy,
                                                    const float* origins, const float* directions, int64_t r) {
  const bool depth = r >= control.n_rays;
  const int64_t first = depth ? control.n_rays : 0;
  MarchArgs<float> args;
  args.n_rays = depth ? control.n_depths : control.n_rays;
  args.origins = origins + 3 * first;
  args.directions = directions + 3 * first;
  args.occupancy = occupancy;
  args.map = control.map;
  args.step = control.march_step;
  args.near = control.near;
  args.far = control.far;
  args.jitter = control.jitter;
  args.jitter_seed = control.seed;
  args.jitter_stream = StreamAt(depth ? RandomStream::kDepthJitter : RandomStream::kRayJitter, control.step);
  return {args, r - first};
}

struct CountSamples {
  const StepControl* control;
  OccupancyBits occupancy;
  const float *origins, *directions;
  int64_t* counts;  // [room for rays]

  NRFF_HOST_DEVICE void operator()(int64_t r) const {
    int64_t n = 0;
    if (r < RaysOf(*control)) {
      RayMarcher<float> marcher = MarcherOf(*control, occupancy, origins, directions, r);
      float t, point[3];
      while (marcher.Next(t, point)) ++n;
    }
    counts[r] = n;
  }
};

// Offsets beyond the room there is, which end the step without effect, are kept from leading out of it. For i ≤ n.
struct LimitOffsets {
  int64_t n, most;
  int64_t* offsets;  // [n + 1]
  int64_t* total;    // of a StepResult

  NRFF_HOST_DEVICE void operator()(int64_t i) const {
    if (i == n) *total = offsets[n];
    if (offsets[i] > most) offsets[i] = most;
  }
};

struct FillSamples {
  const StepControl* control;
  OccupancyBits occupancy;
  const float *origins, *directions;
  const int64_t* ray_offsets;
  float *t, *delta, *points;  // SampleArrays

  NRFF_HOST_DEVICE void operator()(int64_t r) const {
    if (r >= RaysOf(*control)) return;
    RayMarcher<float> marcher = MarcherOf(*control, occupancy, origins, directions, r);
    for (int64_t i = ray_offsets[r]; i < ray_offsets[r + 1]; ++i) {
      // Compilers may round a ray's march differently in the two kernels: a sample that is not there again has no
      // length.
      float at = 0, point[3] = {0, 0, 0};
      const bool is_there = marcher.Next(at, point);
      t[i] = at;
      delta[i] = is_there ? static_cast<float>(control->march_step) : 0.F;
      for (int k = 0; k < 3; ++k) points[3 * i + k] = point[k];
    }
  }
};

struct ComputeWeights {
  const StepControl* control;
  WeightsArgs<float> args;

  NRFF_HOST_DEVICE void operator()(int64_t r) const {
    if (r >= RaysOf(*control)) return;
    WeightsArgs<float> with_stop = args;
    with_stop.stop_transmittance = control->stop_transmittance;
    WeightsForwardRay(with_stop, r);
  }
};

// The greatest of some thresholds whose samples of less weight sum to at most the tolerance, and that sum.
struct RayThreshold {
  float value, left_out = 0;

  NRFF_HOST_DEVICE RayThreshold(const StepControl& control, const float* weights, int64_t begin, int64_t end)
      : value(control.weight_threshold) {
    if (control.colour_tolerance <= 0) return;
    constexpr int kRungs = 10;
    float sums[kRungs] = {};
    for (int64_t i = begin; i < end; ++i) {
      float rung = control.colour_tolerance;
      for (int k = 0; k < kRungs && weights[i] <= rung; ++k, rung *= 0.5F) sums[k] += weights[i];
    }
    float rung = control.colour_tolerance;
    for (int k = 0; k < kRungs && rung > value; ++k, rung *= 0.5F) {
      if (sums[k] > control.colour_tolerance) continue;
      value = rung;
      left_out = sums[k];
    }
  }
};

struct CountShaded {
  const StepControl* control;
  const int64_t* ray_offsets;
  const float* weights;
  int64_t* counts;  // [room for rays]

  NRFF_HOST_DEVICE void operator()(int64_t r) const {
    int64_t n = 0;
    if (r < control->n_rays) {
      const RayThreshold threshold(*control, weights, ray_offsets[r], ray_offsets[r + 1]);
      for (int64_t i = ray_offsets[r]; i < ray_offsets[r + 1]; ++i) n += weights[i] > threshold.value;
    }
    counts[r] = n;
  }
};

struct FillShaded {
  const StepControl* control;
  const int64_t *ray_offsets, *shaded_offsets;
  const float *weights, *points, *directions;
  int64_t* shaded;                           // sample
  float *shaded_points, *shaded_directions;  // [n_shaded, 3]

  NRFF_HOST_DEVICE void operator()(int64_t r) const {
    if (r >= control->n_rays) return;
    const RayThreshold threshold(*control, weights, ray_offsets[r], ray_offsets[r + 1]);
    int64_t to = shaded_offsets[r];
    for (int64_t i = ray_offsets[r]; i < ray_offsets[r + 1] && to < shaded_offsets[r + 1]; ++i) {
      if (!(weights[i] > threshold.value)) continue;
      shaded[to] = i;
      for (int k = 0; k < 3; ++k) {
        shaded_points[3 * to + k] = points[3 * i + k];
        shaded_directions[3 * to + k] = directions[3 * r + k];
      }
      ++to;
    }
  }
};

// What depth rays ask of their samples' weights, and the error; TrainingStep::MatchDepths.
struct MatchDepths {
  const StepControl* control;
  const int64_t* ray_offsets;
  const float *t, *weights, *distance, *spread;
  float *d_weights, *d_transmittance;
  StepResult* result;

  NRFF_HOST_DEVICE void operator()(int64_t i) const {
    if (i >= control->n_depths) return;
    const int64_t r = control->n_rays + i;
    const double per_ray = 1 / static_cast<double>(control->n_depths);
    const auto scale = static_cast<float>(control->depth * per_ray);
    double matched = 0;
    for (int64_t s = ray_offsets[r]; s < ray_offsets[r + 1]; ++s) {
      const float off = (t[s] - distance[i]) / spread[i];
      const float match = std::exp(-0.5F * off * off);
      matched += static_cast<double>(weights[s]) * match;
      d_weights[s] = -scale * match;
    }
    d_transmittance[r] = 0;
    AtomicAdd(&result->depth, (1 - matched) * per_ray);
  }
};

struct WeightsBackward {
  const StepControl* control;
  WeightsBackwardArgs<float> args;

  NRFF_HOST_DEVICE void operator()(int64_t r) const {
    if (r < RaysOf(*control)) WeightsBackwardRay(args, r);
  }
};

// Adds the sparsity loss, which sees a colour ray's samples before its stop.
struct AddSparsity {
  const StepControl* control;
  const int64_t *ray_offsets, *n_reached;
  const float *sigma, *delta;
  float* d_sigma;
  StepResult* result;

  NRFF_HOST_DEVICE void operator()(int64_t r) const {
    if (r >= control->n_rays || control->sparsity <= 0) return;
    const double per_ray = 1 / static_cast<double>(control->n_rays);
    const auto scale = static_cast<float>(control->sparsity * per_ray);
    double sum = 0;
    for (int64_t i = ray_offsets[r]; i < ray_offsets[r] + n_reached[r]; ++i) {
      const float opacity = -std::expm1(-sigma[i] * delta[i]);
      sum += opacity;
      d_sigma[i] += scale * delta[i] * (1 - opacity);
    }
    AtomicAdd(&result->sparsity, sum * per_ray);
  }
};

}  // namespace nrff::device
