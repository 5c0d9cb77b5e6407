// Where a step of the NRFF model on a GPU (step_program.h) leaves what it makes on its way: one block of memory, laid
// out for as many rays, samples and shaded samples as there is room for.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "model/cuda/gpu_trainer.h"
#include "model/kernels/shading_programs.h"
#include "render/kernels/device_runtime.h"

namespace nrff::device {

// How networks' activations and the grids' tables are stored.
struct FloatStorage {
  using Number = float;
  using Table = float;
};
struct HalfStorage {
  using Number = Bf16;
  using Table = Half;
};

// Hands out parts of one block of memory. With no block it counts what they need.
class Arena {
 public:
  explicit Arena(char* memory) : memory_(memory) {}
  template <typename T>
  T* Take(int64_t n) {
    constexpr size_t kAlignment = 256;
    char* at = memory_ == nullptr ? nullptr : memory_ + used_;
    used_ += (static_cast<size_t>(n) * sizeof(T) + kAlignment - 1) / kAlignment * kAlignment;
    return reinterpret_cast<T*>(at);
  }
  size_t used() const { return used_; }

 private:
  char* memory_;
  size_t used_ = 0;
};

inline int64_t Padded(int64_t columns) { return (columns + 7) / 8 * 8; }

// What a step leaves in memory on its way, laid out for a room.
template <typename Storage>
struct StepMemory {
  using Number = typename Storage::Number;
  struct Hidden {
    Number *values, *derivative;
  };

  StepMemory(const GpuModel& model, const ShadingColumns& columns, const GpuRoom& room, bool trains, Arena& arena) {
    const bool directional = model.encoding == DirectionalEncoding::kRee;
    const int64_t n = room.samples, k = room.shaded;
    const auto take_backward = [&](auto of, int64_t size) {
      return trains ? arena.Take<decltype(of)>(size) : static_cast<decltype(of)*>(nullptr);
    };
    origins = arena.Take<float>(3 * room.rays);
    directions = arena.Take<float>(3 * room.rays);
    target = take_backward(float{}, 3 * room.rays);
    view_of_ray = take_backward(int{}, room.rays);
    distance = take_backward(float{}, room.rays);
    spread = take_backward(float{}, room.rays);
    counts = arena.Take<int64_t>(room.rays);
    ray_offsets = arena.Take<int64_t>(room.rays + 1);
    shaded_offsets = arena.Take<int64_t>(room.rays + 1);
    scratch_bytes = ScratchOfSums(room.rays);
    scratch = arena.Take<char>(static_cast<int64_t>(scratch_bytes));
    transmittance = arena.Take<float>(room.rays);
    d_transmittance = take_backward(float{}, room.rays);
    n_reached = arena.Take<int64_t>(room.rays);

    t = arena.Take<float>(n);
    delta = arena.Take<float>(n);
    points = arena.Take<float>(3 * n);
    sigma = arena.Take<float>(n);
    weights = arena.Take<float>(n);
    d_weights = take_backward(float{}, n);
    d_sigma = take_backward(float{}, n);

    shaded = arena.Take<int64_t>(k);
    shaded_points = arena.Take<float>(3 * k);
    shaded_directions = arena.Take<float>(3 * k);
    rgb = arena.Take<float>(3 * k);
    d_rgb = take_backward(float{}, 3 * k);
    d_normals = take_backward(float{}, 3 * k);
    int64_t widest = 0;
    const auto take_hidden = [&](const std::vector<GpuModel::Layer>& layers, std::vector<Hidden>& hidden) {
      for (size_t l = 0; l < layers.size(); ++l) {
        widest = std::max({widest, Padded(layers[l].n_in), Padded(layers[l].n_out)});
        if (l + 1 == layers.size()) break;
        auto* values = arena.Take<Number>(k * Padded(layers[l].n_out));
        hidden.push_back({values, take_backward(Number{}, k * Padded(layers[l].n_out))});
      }
    };
    features = arena.Take<Number>(k * Padded(model.spatial.front().n_in));
    d_features = take_backward(Number{}, k * Padded(model.spatial.front().n_in));
    take_hidden(model.spatial, spatial_hidden);
    spatial_out = arena.Take<float>(k * columns.spatial_out_row);
    d_spatial_out = take_backward(Number{}, k * columns.spatial_out_row);
    if (directional) {
      reflections = arena.Take<Reflection>(k);
      d_reflected = take_backward(float{}, 3 * k);
      directional_in = arena.Take<Number>(k * columns.directional_in_row);
      d_directional_in = take_backward(Number{}, k * columns.directional_in_row);
      lobe_in = arena.Take<Number>(k * columns.n_theta * columns.lobe_in_row);
      lobe_raw = arena.Take<float>(k * columns.n_theta * columns.lobe_raw_row);
      d_lobe_in = take_backward(Number{}, k * columns.n_theta * columns.lobe_in_row);
      d_lobe_raw = take_backward(Number{}, k * columns.n_theta * columns.lobe_raw_row);
      take_hidden(model.directional, directional_hidden);
      specular = arena.Take<float>(k * columns.specular_row);
      d_specular = take_backward(Number{}, k * columns.specular_row);
    }
    for (Number*& gradient : layer_gradients) gradient = take_backward(Number{}, k * widest);
    colour = arena.Take<float>(3 * room.rays);
    depth = arena.Take<float>(room.rays);
    normal = arena.Take<float>(3 * room.rays);
    opacity = arena.Take<float>(room.rays);
  }

  // Per ray.
  float *origins, *directions, *target, *distance, *spread, *transmittance, *d_transmittance;
  float *colour, *depth, *normal, *opacity;  // of pictures
  int64_t *counts, *ray_offsets, *shaded_offsets, *n_reached;
  int* view_of_ray;
  char* scratch;
  size_t scratch_bytes;
  // Per sample.
  float *t, *delta, *points, *sigma, *weights, *d_weights, *d_sigma;
  // Per shaded sample.
  int64_t* shaded;
  float *shaded_points, *shaded_directions, *rgb, *d_rgb, *d_normals;
  Number *features, *d_features;
  std::vector<Hidden> spatial_hidden, directional_hidden;
  float* spatial_out;
  Number* d_spatial_out;
  Reflection* reflections = nullptr;
  float *d_reflected = nullptr, *lobe_raw = nullptr, *specular = nullptr;
  Number *directional_in = nullptr, *d_directional_in = nullptr, *lobe_in = nullptr, *d_lobe_in = nullptr,
         *d_lobe_raw = nullptr, *d_specular = nullptr;
  Number* layer_gradients[2];  // of a hidden layer's values, by turns
};

}  // namespace nrff::device
