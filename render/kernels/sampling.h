// Sample positions along rays: marching through the occupied cells of the scene.
//
// Every ray has a fixed lattice of candidate positions, a function of the ray, the step and the jitter alone; a
// candidate becomes a sample where the occupancy bit of its cell is set. Empty blocks of 8³ cells are jumped over,
// which never changes the set of samples.
//
// Bounded scene: t_i = t₀ + i·step for t in [near, far] and inside the box, t₀ = the ray's entry into both (a slab
// test), plus jitter·step.
// Unbounded scene: t₀ = near plus jitter of a step, and the step in t is step·max(1, m²)/|d/h|, where u = (x − c)/h,
// m = |u|∞ and d/h is the ray's direction in u (scene_map.h): `step` contracted units where the ray moves radially.
// Inside the foreground box that is a lattice of constant step again.
//
// delta is `step` for every sample: the measure σ is defined in (scene units, or contracted units when unbounded).
//
// Two passes, since the number of samples is not known before: CountSamples, then FillSamples with the caller's
// memory. Both are parallel over rays and deterministic, whatever the number of threads.
#pragma once

#include <cstdint>

#include "render/kernels/occupancy_bits.h"
#include "render/scene_map.h"

namespace nrff {

template <typename Scalar>
struct MarchArgs {
  int64_t n_rays = 0;
  const Scalar* origins = nullptr;     // [n_rays, 3] scene units
  const Scalar* directions = nullptr;  // [n_rays, 3] unit
  OccupancyBits occupancy;
  SceneMap map;
  double step = 0;           // > 0; scene units, or contracted units when unbounded
  double near = 0, far = 0;  // scene units along the ray, near < far < ∞
  // The first sample of ray r is moved by Uniform(jitter_seed, jitter_stream, r) of a step.
  bool jitter = false;
  uint64_t jitter_seed = 0, jitter_stream = 0;
};

template <typename Scalar>
struct SampleArrays {            // outputs, overwritten; n_samples = ray_offsets[n_rays]
  Scalar* t = nullptr;           // [n_samples] scene units along the ray, increasing within a ray
  Scalar* delta = nullptr;       // [n_samples]
  Scalar* points = nullptr;      // [n_samples, 3] field coordinates
  int64_t* ray_index = nullptr;  // [n_samples]
};

// ray_offsets [n_rays + 1], overwritten: the samples of ray r are ray_offsets[r] … ray_offsets[r + 1] − 1. Returns
// their total. Defined for float and double, as FillSamplesCpu is.
template <typename Scalar>
int64_t CountSamplesCpu(const MarchArgs<Scalar>& args, int64_t* ray_offsets);

// `args` and `ray_offsets` as CountSamplesCpu had and left them.
template <typename Scalar>
void FillSamplesCpu(const MarchArgs<Scalar>& args, const int64_t* ray_offsets, const SampleArrays<Scalar>& samples);

}  // namespace nrff
