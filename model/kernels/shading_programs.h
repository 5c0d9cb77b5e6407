// The networks of NRFF (shading_tile.h) as kernels of device_runtime.h, between its matrix products; and Adam.
//
// Activations lie row by row, [room for samples][columns], columns padded with zeros to a multiple of 8. Rows beyond
// the samples that there are hold finite numbers, and their gradients are zero: the networks do not ask how many there
// are.
#pragma once

#include <cmath>
#include <cstdint>

#include "model/kernels/activation.h"
#include "model/kernels/ree.h"
#include "model/kernels/ree_lobe.h"
#include "model/kernels/reflection.h"
#include "render/kernels/colour_correction.h"
#include "render/kernels/device_runtime.h"
#include "render/kernels/trace_programs.h"

namespace nrff::device {

// weight [n_out, n_in] → packed [padded out][row], padded with zeros.
template <typename T>
struct PackWeight {
  const float* weight;
  int n_out, n_in;
  int64_t row;
  T* packed;

  NRFF_HOST_DEVICE void operator()(int64_t i) const {
    const int64_t r = i / row, c = i % row;
    FromFloat(r < n_out && c < n_in ? weight[r * n_in + c] : 0.F, packed[i]);
  }
};

// The reverse, of gradients.
struct UnpackGradient {
  const float* packed;
  int n_in;
  int64_t row;
  float* gradient;  // [n_out, n_in]

  NRFF_HOST_DEVICE void operator()(int64_t i) const { gradient[i] = packed[i / n_in * row + i % n_in]; }
};

// values [room][row] += bias in the first n columns.
struct AddBias {
  const float* bias;
  int64_t n, row;
  float* values;

  NRFF_HOST_DEVICE void operator()(int64_t i) const {
    const int64_t c = i % row;
    if (c < n) values[i] += bias[c];
  }
};

// A hidden layer's products → its activations and their derivative, in place of the products.
template <typename T>
struct Activate {
  const float* bias;
  int64_t n, row;
  Activation activation;
  bool active;             // or only the bias
  T *values, *derivative;  // derivative may be null

  NRFF_HOST_DEVICE void operator()(int64_t i) const {
    const int64_t c = i % row;
    float x = 0, slope = 0;
    if (c < n) {
      x = ToFloat(values[i]) + bias[c];
      slope = 1;
      if (active && activation == Activation::kGelu) {
        FastGelu(x, x, slope);
      } else if (active) {
        slope = x > 0 ? 1.F : 0.F;
        x = x < 0 ? 0.F : x;  // NaN stays
      }
    }
    FromFloat(x, values[i]);
    if (derivative != nullptr) FromFloat(slope, derivative[i]);
  }
};

template <typename T>
struct MultiplyBy {
  const T* factor;
  T* values;

  NRFF_HOST_DEVICE void operator()(int64_t i) const { FromFloat(ToFloat(values[i]) * ToFloat(factor[i]), values[i]); }
};

// Column sums of values [room][row] onto bias gradients. Index: part of the rows · n + column.
template <typename T>
struct SumColumns {
  static constexpr int64_t kRows = 256;  // of a part
  const T* values;
  int64_t room, n, row;
  float* sums;  // accumulates

  NRFF_HOST_DEVICE int64_t size() const { return (room + kRows - 1) / kRows * n; }
  NRFF_HOST_DEVICE void operator()(int64_t i) const {
    const int64_t c = i % n, begin = i / n * kRows, end = begin + kRows < room ? begin + kRows : room;
    float sum = 0;
    for (int64_t r = begin; r < end; ++r) sum += ToFloat(values[r * row + c]);
    AtomicAdd(sums + c, sum);
  }
};

// Where things lie in the rows of spatial_out, directional_in, lobe_in and lobe_raw.
struct ShadingColumns {
  static constexpr int kDiffuse = 0, kTint = 3, kNormal = 6, kBottleneck = 9;
  int bottleneck_width, lobe_row_width, n_theta, n_phi;
  int64_t spatial_out_row, directional_in_row, lobe_in_row, lobe_raw_row, specular_row;

  NRFF_HOST_DEVICE int n_lobes() const { return n_theta * n_phi; }
  NRFF_HOST_DEVICE int share() const { return kBottleneck + bottleneck_width; }  // of spatial_out, features of lobes
  NRFF_HOST_DEVICE int n_spatial_out() const { return share() + n_theta * lobe_row_width; }
  NRFF_HOST_DEVICE int cosine() const { return bottleneck_width + kLobeAmplitudes * n_lobes(); }  // of directional_in
};

// Per sample: normal, reflection, and the cosine and the padding of directional_in.
template <typename T>
struct ReflectSamples {
  ShadingColumns columns;
  const int64_t* n_samples;
  const float *spatial_out, *directions;
  Reflection* reflections;
  T* directional_in;

  NRFF_HOST_DEVICE void operator()(int64_t k) const {
    const float* raw = spatial_out + k * columns.spatial_out_row + ShadingColumns::kNormal;
    const bool is_sample = k < *n_samples;
    const float* d = directions + 3 * k;
    const Reflection at(raw[0], raw[1], raw[2], is_sample ? d[0] : 0.F, is_sample ? d[1] : 0.F, is_sample ? d[2] : 1.F);
    reflections[k] = at;
    T* in = directional_in + k * columns.directional_in_row;
    FromFloat(at.cosine, in[columns.cosine()]);
    for (int64_t c = columns.cosine() + 1; c < columns.directional_in_row; ++c) FromFloat(0.F, in[c]);
  }
};

// spatial_out → bottleneck of directional_in, and lobe_in [room · n_theta][lobe_in_row]. Index: sample · row of
// spatial_out + column, so that neighbours read neighbours.
template <typename T>
struct ShareSpatial {
  ShadingColumns columns;
  const float* spatial_out;
  T *directional_in, *lobe_in;

  NRFF_HOST_DEVICE void operator()(int64_t i) const {
    const int64_t k = i / columns.spatial_out_row;
    const int c = static_cast<int>(i % columns.spatial_out_row);
    if (c < ShadingColumns::kBottleneck || c >= columns.n_spatial_out()) return;
    if (c < columns.share()) {
      FromFloat(spatial_out[i], directional_in[k * columns.directional_in_row + c - ShadingColumns::kBottleneck]);
      return;
    }
    const int row = (c - columns.share()) / columns.lobe_row_width, f = (c - columns.share()) % columns.lobe_row_width;
    T* in = lobe_in + (k * columns.n_theta + row) * columns.lobe_in_row;
    FromFloat(spatial_out[i], in[f]);
    if (f + 1 < columns.lobe_row_width) return;
    for (int64_t pad = columns.lobe_row_width; pad < columns.lobe_in_row; ++pad) FromFloat(0.F, in[pad]);
  }
};

// Index: sample · n_lobes + lobe. lobes [n_lobes].
template <typename T>
struct EncodeLobes {
  ShadingColumns columns;
  const Lobe<float>* lobes;
  const Reflection* reflections;
  const float* lobe_raw;
  T* directional_in;

  NRFF_HOST_DEVICE void operator()(int64_t i) const {
    const int64_t k = i / columns.n_lobes();
    const int l = static_cast<int>(i % columns.n_lobes()), row = l / columns.n_phi, j = l % columns.n_phi;
    const float* raw = lobe_raw + (k * columns.n_theta + row) * columns.lobe_raw_row + j * kLobeParameters;
    const float* o = reflections[k].reflected;
    const LobeResponse<float> at(lobes[l], o[0], o[1], o[2], raw[2], raw[3]);
    T* out = directional_in + k * columns.directional_in_row + columns.bottleneck_width + l * kLobeAmplitudes;
    FromFloat(raw[0] * at.response, out[0]);
    FromFloat(raw[1] * at.response, out[1]);
  }
};

// Index: sample · n_theta + row of lobes. d_reflected [room, 3] accumulates.
template <typename T>
struct EncodeLobesBackward {
  ShadingColumns columns;
  const Lobe<float>* lobes;
  const Reflection* reflections;
  const float* lobe_raw;
  const T* d_directional_in;
  T* d_lobe_raw;
  float* d_reflected;

  NRFF_HOST_DEVICE void operator()(int64_t i) const {
    const int64_t k = i / columns.n_theta;
    const int row = static_cast<int>(i % columns.n_theta);
    const float* raw = lobe_raw + i * columns.lobe_raw_row;
    T* d_raw = d_lobe_raw + i * columns.lobe_raw_row;
    const float* o = reflections[k].reflected;
    float d_o[3] = {0, 0, 0};
    for (int j = 0; j < columns.n_phi; ++j, raw += kLobeParameters, d_raw += kLobeParameters) {
      const int l = row * columns.n_phi + j;
      const T* d = d_directional_in + k * columns.directional_in_row + columns.bottleneck_width + l * kLobeAmplitudes;
      const LobeResponse<float> at(lobes[l], o[0], o[1], o[2], raw[2], raw[3]);
      const LobeGradient<float> gradient(lobes[l], at, raw[0], raw[1], ToFloat(d[0]), ToFloat(d[1]));
      FromFloat(gradient.d_a0, d_raw[0]);
      FromFloat(gradient.d_a1, d_raw[1]);
      FromFloat(gradient.d_raw_lambda, d_raw[2]);
      FromFloat(gradient.d_raw_mu, d_raw[3]);
      d_o[0] += gradient.d_x;
      d_o[1] += gradient.d_y;
      d_o[2] += gradient.d_z;
    }
    for (int64_t c = int64_t(columns.n_phi) * kLobeParameters; c < columns.lobe_raw_row; ++c, ++d_raw) {
      FromFloat(0.F, *d_raw);
    }
    for (int axis = 0; axis < 3; ++axis) AtomicAdd(d_reflected + 3 * k + axis, d_o[axis]);
  }
};

// rgb [room, 3]; specular null: without a directional network.
struct ColourSamples {
  const float *spatial_out, *specular;
  int64_t spatial_out_row, specular_row;
  float* rgb;

  NRFF_HOST_DEVICE void operator()(int64_t k) const {
    const float* out = spatial_out + k * spatial_out_row;
    for (int c = 0; c < 3; ++c) {
      const float shine = specular != nullptr ? out[ShadingColumns::kTint + c] * specular[k * specular_row + c] : 0.F;
      rgb[3 * k + c] = FastSigmoid(out[ShadingColumns::kDiffuse + c] + shine);
    }
  }
};

// Colours of rays, what is wrong with them, and what that asks of the samples: TrainingStep::Composite.
struct CompositeRays {
  const StepControl* control;
  const int64_t *shaded_offsets, *shaded;
  const float *weights, *transmittance, *target, *rgb, *shaded_directions;
  const Reflection* reflections;  // null: without normals
  const int* view_of_ray;
  const float* corrections;  // [n_views, 12]; null: none
  float *d_weights, *d_transmittance, *d_rgb, *d_normals, *d_corrections;
  StepResult* result;

  NRFF_HOST_DEVICE void operator()(int64_t r) const {
    if (r >= control->n_rays) return;
    const auto mse_scale = static_cast<float>(2 / (3 * static_cast<double>(control->n_rays)));
    const int64_t n_shaded = result->n_shaded > 0 ? result->n_shaded : 1;
    const double per_shaded = 1 / static_cast<double>(n_shaded);
    const auto orientation_scale = static_cast<float>(control->orientation * per_shaded);
    const int64_t begin = shaded_offsets[r], end = shaded_offsets[r + 1];
    const int64_t first = corrections == nullptr ? 0 : kCorrectionParameters * static_cast<int64_t>(view_of_ray[r]);
    const float* correction = corrections == nullptr ? nullptr : corrections + first;
    float light[3], colour[3], d_colour[3], d_light[3];
    double mse = 0, orientation = 0;
    for (int c = 0; c < 3; ++c) {
      light[c] = 0;
      for (int64_t k = begin; k < end; ++k) light[c] += weights[shaded[k]] * rgb[3 * k + c];
    }
    CorrectedColour(correction, light, transmittance[r], control->background, colour);
    for (int c = 0; c < 3; ++c) {
      const float error = colour[c] - target[3 * r + c];
      mse += static_cast<double>(error) * error / (3 * static_cast<double>(control->n_rays));
      d_colour[c] = mse_scale * error;
    }
    float* d_correction = d_corrections + first;
    d_transmittance[r] = CorrectedColourBackward(correction, light, transmittance[r], control->background, d_colour,
                                                 d_light, [&](int i, float d) { AtomicAdd(d_correction + i, d); });
    for (int64_t k = begin; k < end; ++k) {
      const float weight = weights[shaded[k]];
      float d_weight = 0, facing_away = 0;
      for (int c = 0; c < 3; ++c) {
        d_weight += d_light[c] * rgb[3 * k + c];
        d_rgb[3 * k + c] = weight * d_light[c];
        if (reflections != nullptr) facing_away += reflections[k].normal[c] * shaded_directions[3 * k + c];
      }
      facing_away = facing_away > 0 ? facing_away : 0;
      orientation += static_cast<double>(weight) * facing_away * facing_away * per_shaded;
      d_weight += orientation_scale * facing_away * facing_away;
      const float d_facing = 2 * orientation_scale * weight * facing_away;
      for (int c = 0; c < 3; ++c) d_normals[3 * k + c] = d_facing * shaded_directions[3 * k + c];
      d_weights[shaded[k]] = d_weight;
    }
    AtomicAdd(&result->mse, mse);
    AtomicAdd(&result->orientation, orientation);
  }
};

// What a ray shows, without losses: RenderedImage of render/image_renderer.h, before depths and normals are normalised.
struct PictureRays {
  const StepControl* control;
  const int64_t *ray_offsets, *shaded_offsets, *shaded;
  const float *t, *weights, *transmittance, *rgb;
  const Reflection* reflections;             // null: without normals
  float *colour, *depth, *normal, *opacity;  // [n_rays, 3], [n_rays], [n_rays, 3], [n_rays]

  NRFF_HOST_DEVICE void operator()(int64_t r) const {
    if (r >= control->n_rays) return;
    const RayThreshold threshold(*control, weights, ray_offsets[r], ray_offsets[r + 1]);
    float sum[3] = {}, direction[3] = {}, seen = 0, distance = 0;
    for (int64_t k = shaded_offsets[r]; k < shaded_offsets[r + 1]; ++k) {
      const float weight = weights[shaded[k]];
      seen += weight;
      for (int c = 0; c < 3; ++c) {
        sum[c] += weight * rgb[3 * k + c];
        if (reflections != nullptr) direction[c] += weight * reflections[k].normal[c];
      }
    }
    for (int64_t i = ray_offsets[r]; i < ray_offsets[r + 1]; ++i) distance += weights[i] * t[i];
    // Samples that were left out take the mean colour of the others.
    const float with_left_out = seen > 0 ? 1 + threshold.left_out / seen : 1;
    for (int c = 0; c < 3; ++c) {
      colour[3 * r + c] = with_left_out * sum[c] + transmittance[r] * control->background;
      normal[3 * r + c] = direction[c];
    }
    depth[r] = distance;
    opacity[r] = 1 - transmittance[r];
  }
};

// Per sample, from its colour: the first columns of d_spatial_out, and d_specular with its padding.
template <typename T>
struct ColourBackward {
  const float *spatial_out, *specular, *rgb, *d_rgb;
  int64_t spatial_out_row, specular_row;
  T *d_spatial_out, *d_specular;

  NRFF_HOST_DEVICE void operator()(int64_t k) const {
    T* d_out = d_spatial_out + k * spatial_out_row;
    for (int c = 0; c < 3; ++c) {
      const float d = d_rgb[3 * k + c] * rgb[3 * k + c] * (1 - rgb[3 * k + c]);
      FromFloat(d, d_out[ShadingColumns::kDiffuse + c]);
      if (specular == nullptr) continue;
      FromFloat(d * specular[k * specular_row + c], d_out[ShadingColumns::kTint + c]);
      FromFloat(d * spatial_out[k * spatial_out_row + ShadingColumns::kTint + c], d_specular[k * specular_row + c]);
    }
    if (specular == nullptr) {
      for (int64_t c = 3; c < spatial_out_row; ++c) FromFloat(0.F, d_out[c]);
    } else {
      for (int64_t c = 3; c < specular_row; ++c) FromFloat(0.F, d_specular[k * specular_row + c]);
    }
  }
};

// The other columns of d_spatial_out. Index as ShareSpatial's.
template <typename T>
struct GatherSpatialGradient {
  ShadingColumns columns;
  const Reflection* reflections;
  const int64_t* n_samples;
  const float *directions, *d_reflected, *d_normals;
  const T *d_directional_in, *d_lobe_in;
  T* d_spatial_out;

  NRFF_HOST_DEVICE void operator()(int64_t i) const {
    const int64_t k = i / columns.spatial_out_row;
    const int c = static_cast<int>(i % columns.spatial_out_row);
    if (c < ShadingColumns::kNormal) return;
    if (c == ShadingColumns::kNormal) {
      float d_raw[3] = {0, 0, 0};
      if (k < *n_samples) {
        const Reflection& at = reflections[k];
        const float d_cosine = ToFloat(d_directional_in[k * columns.directional_in_row + columns.cosine()]);
        ReflectionBackward(at.normal, at.inverse_norm, at.cosine, directions + 3 * k, d_cosine, d_reflected + 3 * k,
                           d_normals + 3 * k, d_raw);
      }
      for (int axis = 0; axis < 3; ++axis) FromFloat(d_raw[axis], d_spatial_out[i + axis]);
    } else if (c >= columns.n_spatial_out()) {
      FromFloat(0.F, d_spatial_out[i]);
    } else if (c >= columns.share()) {
      const int row = (c - columns.share()) / columns.lobe_row_width;
      const int f = (c - columns.share()) % columns.lobe_row_width;
      d_spatial_out[i] = d_lobe_in[(k * columns.n_theta + row) * columns.lobe_in_row + f];
    } else if (c >= ShadingColumns::kBottleneck) {
      d_spatial_out[i] = d_directional_in[k * columns.directional_in_row + c - ShadingColumns::kBottleneck];
    }
  }
};

// Adam and what a step ends with. What changes from step to step is kept on the device.
struct AdamState {
  int64_t t = 0;
  float beta1 = 0, beta2 = 0, grid_step = 0, network_step = 0, correction_step = 0, root_correction2 = 0, epsilon = 0;
};

// The L1 term of the density grid: the gradient of its planes and lines by the sign of their values.
struct DensityL1 {
  int n_factors = 0;
  const int64_t* begins = nullptr;  // [n_factors + 1] of the planes and lines, in their order in memory
  NRFF_HOST_DEVICE float Gradient(int64_t i, float value, float density_l1) const {
    if (density_l1 == 0 || i >= begins[n_factors] || value == 0) return 0;
    int low = 0, high = n_factors;
    while (high - low > 1) {
      const int middle = (low + high) / 2;
      (begins[middle] <= i ? low : high) = middle;
    }
    const auto n = static_cast<double>(begins[low + 1] - begins[low]);
    const auto rate = static_cast<float>(density_l1 / (n * n_factors));
    return value > 0 ? rate : -rate;
  }
};

struct FindNotFinite {
  const float* gradient;
  StepResult* result;

  NRFF_HOST_DEVICE void operator()(int64_t i) const {
    const float g = gradient[i];
    if (!(g - g == 0)) AtomicMin(&result->first_not_finite, static_cast<unsigned long long>(i));
  }
};

// Whether the step counts, and Adam's numbers for it. One call.
struct DecideStep {
  const StepControl* control;
  int64_t room_for_samples, room_for_shaded;
  AdamState* adam;
  StepResult* result;

  NRFF_HOST_DEVICE void operator()(int64_t /*i*/) const {
    const double loss = result->mse + result->orientation + result->sparsity + result->depth;
    const bool finite = loss - loss == 0 && result->first_not_finite == ~0ULL;
    const bool fits = result->n_samples <= room_for_samples && result->n_shaded <= room_for_shaded;
    result->had_room = fits ? 1 : 0;
    result->applied = finite && fits ? 1 : 0;
    if (result->applied != 0) {
      ++adam->t;
      const auto t = static_cast<double>(adam->t);
      const double correction1 = 1 - std::pow(control->beta1, t);
      adam->beta1 = static_cast<float>(control->beta1);
      adam->beta2 = static_cast<float>(control->beta2);
      adam->grid_step = static_cast<float>(control->grid_rate / correction1);
      adam->network_step = static_cast<float>(control->network_rate / correction1);
      adam->correction_step = static_cast<float>(control->correction_rate / correction1);
      adam->root_correction2 = static_cast<float>(1 / std::sqrt(1 - std::pow(control->beta2, t)));
      adam->epsilon = static_cast<float>(control->epsilon);
    }
    result->adam_t = adam->t;
    result->step = control->step;
    result->n_rays = control->n_rays;
  }
};

// parameters [n], the grids first, the colour corrections last, and the tables made of these. Lazy grids leave blocks
// of 16 elements without gradient as they are (adam.h); so is an element that is zero where the L1 term alone touches
// its block.
template <typename Table>
struct AdamProgram {
  const StepControl* control;
  const StepResult* result;
  const AdamState* adam;
  int64_t n_grid, corrections_begin;
  int n_corrected;  // views
  DensityL1 l1;
  const float* gradient;
  float *parameters, *m, *v;
  Table* tables;  // [n_grid], or null where the kernels read the parameters themselves

  NRFF_HOST_DEVICE void operator()(int64_t i) const {
    constexpr int64_t kLazyBlock = 16;
    if (result->applied == 0) return;
    const bool grid = i < n_grid;
    const bool correction = i >= corrections_begin;
    const float g = correction ? gradient[i] + 2 * control->correction / static_cast<float>(n_corrected) * parameters[i]
                               : gradient[i] + l1.Gradient(i, parameters[i], control->density_l1);
    if (grid && control->lazy_grids && g == 0) {
      const int64_t begin = i / kLazyBlock * kLazyBlock;
      bool touched = false;
      for (int64_t j = begin; j < begin + kLazyBlock && j < n_grid; ++j) touched = touched || gradient[j] != 0;
      if (!touched) return;
    }
    m[i] = adam->beta1 * m[i] + (1 - adam->beta1) * g;
    v[i] = adam->beta2 * v[i] + (1 - adam->beta2) * g * g;
    const float step = grid ? adam->grid_step : correction ? adam->correction_step : adam->network_step;
    parameters[i] -= step * m[i] / (std::sqrt(v[i]) * adam->root_correction2 + adam->epsilon);
    if (grid && tables != nullptr) FromFloat(parameters[i], tables[i]);
  }
};

template <typename T>
struct Convert {
  const float* from;
  T* to;

  NRFF_HOST_DEVICE void operator()(int64_t i) const { FromFloat(from[i], to[i]); }
};

// mean += (value − mean)/n
struct AddToMean {
  const float* values;
  float inverse_n;
  float* mean;

  NRFF_HOST_DEVICE void operator()(int64_t i) const { mean[i] += (values[i] - mean[i]) * inverse_n; }
};

// One call, at a step's start.
struct BeginStep {
  StepResult* result;

  NRFF_HOST_DEVICE void operator()(int64_t /*i*/) const {
    *result = StepResult{};
    result->first_not_finite = ~0ULL;
  }
};

}  // namespace nrff::device
