#include "render/volume_renderer.h"

#include <ATen/ATen.h>
#include <torch/csrc/autograd/custom_function.h>

#include <cmath>
#include <string>

#include "pipeline/error.h"
#include "render/kernels/camera_rays.h"
#include "render/kernels/compositing.h"
#include "render/kernels/random.h"
#include "render/kernels/sampling.h"

namespace nrff {
namespace {

using torch::Tensor;
using torch::autograd::AutogradContext;
using torch::autograd::tensor_list;

// Calls body(Scalar{}) with the tensors' scalar type.
template <typename Body>
void WithScalar(torch::Dtype type, Body&& body) {
  if (type == torch::kFloat) {
    body(float{});
  } else if (type == torch::kDouble) {
    body(double{});
  } else {
    throw InputError(std::string("rays are ") + c10::toString(type) + "; the renderer takes float or double");
  }
}

template <typename Scalar>
Scalar* Out(Tensor& tensor) {
  return tensor.mutable_data_ptr<Scalar>();
}
template <typename Scalar>
const Scalar* In(const Tensor& tensor) {
  return tensor.const_data_ptr<Scalar>();
}

// A gradient that never arrived is zero; one that was expanded is not contiguous.
Tensor GradOr0(const Tensor& grad, const Tensor& like) {
  return grad.defined() ? grad.contiguous() : at::zeros_like(like);
}

// sigma → (weights, T_end); see compositing.h.
class Weights : public torch::autograd::Function<Weights> {
 public:
  static tensor_list forward(AutogradContext* ctx, const Tensor& sigma_in, const Tensor& delta,
                             const Tensor& ray_offsets, double stop_transmittance) {
    const Tensor sigma = sigma_in.contiguous();
    const int64_t n_rays = ray_offsets.numel() - 1;
    Tensor weights = at::empty_like(sigma);
    Tensor transmittance = at::empty({n_rays}, sigma.options());
    Tensor n_reached = at::empty({n_rays}, ray_offsets.options());
    WithScalar(sigma.scalar_type(), [&](auto scalar) {
      using Scalar = decltype(scalar);
      WeightsForwardCpu(WeightsArgs<Scalar>{.n_rays = n_rays,
                                            .ray_offsets = In<int64_t>(ray_offsets),
                                            .sigma = In<Scalar>(sigma),
                                            .delta = In<Scalar>(delta),
                                            .stop_transmittance = static_cast<Scalar>(stop_transmittance),
                                            .weights = Out<Scalar>(weights),
                                            .transmittance = Out<Scalar>(transmittance),
                                            .n_reached = Out<int64_t>(n_reached)});
    });
    ctx->save_for_backward({delta, ray_offsets, weights, transmittance, n_reached});
    return {weights, transmittance};
  }

  static tensor_list backward(AutogradContext* ctx, const tensor_list& grads) {
    const tensor_list saved = ctx->get_saved_variables();
    const Tensor &delta = saved[0], &ray_offsets = saved[1], &weights = saved[2], &transmittance = saved[3];
    const Tensor dL_dweights = GradOr0(grads[0], weights);
    const Tensor dL_dtransmittance = GradOr0(grads[1], transmittance);
    Tensor dL_dsigma = at::empty_like(weights);
    WithScalar(weights.scalar_type(), [&](auto scalar) {
      using Scalar = decltype(scalar);
      WeightsBackwardCpu(WeightsBackwardArgs<Scalar>{.n_rays = transmittance.numel(),
                                                     .ray_offsets = In<int64_t>(ray_offsets),
                                                     .delta = In<Scalar>(delta),
                                                     .weights = In<Scalar>(weights),
                                                     .transmittance = In<Scalar>(transmittance),
                                                     .n_reached = In<int64_t>(saved[4]),
                                                     .dL_dweights = In<Scalar>(dL_dweights),
                                                     .dL_dtransmittance = In<Scalar>(dL_dtransmittance),
                                                     .dL_dsigma = Out<Scalar>(dL_dsigma)});
    });
    return {dL_dsigma, {}, {}, {}};
  }
};

// (weights [k], values [k, c]) → Σ over each ray [n, c]
class Accumulate : public torch::autograd::Function<Accumulate> {
 public:
  static Tensor forward(AutogradContext* ctx, const Tensor& weights_in, const Tensor& values_in,
                        const Tensor& ray_offsets) {
    const Tensor weights = weights_in.contiguous(), values = values_in.contiguous();
    const int64_t n_rays = ray_offsets.numel() - 1;
    Tensor out = at::empty({n_rays, values.size(1)}, values.options());
    WithScalar(values.scalar_type(), [&](auto scalar) {
      using Scalar = decltype(scalar);
      AccumulateForwardCpu(AccumulateArgs<Scalar>{.n_rays = n_rays,
                                                  .n_channels = values.size(1),
                                                  .ray_offsets = In<int64_t>(ray_offsets),
                                                  .weights = In<Scalar>(weights),
                                                  .values = In<Scalar>(values),
                                                  .out = Out<Scalar>(out)});
    });
    ctx->save_for_backward({weights, values, ray_offsets});
    return out;
  }

  static tensor_list backward(AutogradContext* ctx, const tensor_list& grads) {
    const tensor_list saved = ctx->get_saved_variables();
    const Tensor &weights = saved[0], &values = saved[1], &ray_offsets = saved[2];
    const Tensor dL_dout = grads[0].contiguous();
    Tensor dL_dweights = at::empty_like(weights), dL_dvalues = at::empty_like(values);
    WithScalar(values.scalar_type(), [&](auto scalar) {
      using Scalar = decltype(scalar);
      AccumulateBackwardCpu(AccumulateBackwardArgs<Scalar>{.n_rays = ray_offsets.numel() - 1,
                                                           .n_channels = values.size(1),
                                                           .ray_offsets = In<int64_t>(ray_offsets),
                                                           .weights = In<Scalar>(weights),
                                                           .values = In<Scalar>(values),
                                                           .dL_dout = In<Scalar>(dL_dout),
                                                           .dL_dweights = Out<Scalar>(dL_dweights),
                                                           .dL_dvalues = Out<Scalar>(dL_dvalues)});
    });
    return {dL_dweights, dL_dvalues, {}};
  }
};

struct Selection {
  Tensor ray_offsets;  // [n_rays + 1] into `indices`
  Tensor indices;      // [n_selected] into the samples
};

Selection SelectSamples(const Tensor& weights, const Tensor& ray_offsets, double threshold) {
  Selection selection;
  selection.ray_offsets = at::empty_like(ray_offsets);
  WithScalar(weights.scalar_type(), [&](auto scalar) {
    using Scalar = decltype(scalar);
    const SelectArgs<Scalar> args{.n_rays = ray_offsets.numel() - 1,
                                  .ray_offsets = In<int64_t>(ray_offsets),
                                  .weights = In<Scalar>(weights),
                                  .threshold = static_cast<Scalar>(threshold)};
    const int64_t n = CountSelectedCpu(args, Out<int64_t>(selection.ray_offsets));
    selection.indices = at::empty({n}, ray_offsets.options());
    FillSelectedCpu(args, In<int64_t>(selection.ray_offsets), Out<int64_t>(selection.indices));
  });
  return selection;
}

}  // namespace

void CheckOptions(const RenderOptions& options) {
  const auto refuse = [](const char* name, double value, const char* expected) {
    return InputError("the render option " + std::string(name) + " is " + std::to_string(value) + "; it must be " +
                      expected);
  };
  if (!(options.step > 0) || !std::isfinite(options.step)) throw refuse("step", options.step, "positive and finite");
  if (!(options.near >= 0)) throw refuse("near", options.near, "at least 0");
  if (!(options.far > options.near) || !std::isfinite(options.far)) {
    throw refuse("far", options.far, "finite and beyond near");
  }
}

Rays RaysThroughPixels(const std::vector<View>& views, const Tensor& pixels, torch::Dtype type) {
  std::vector<PinholeCamera> cameras(views.size());
  for (size_t i = 0; i < views.size(); ++i) {
    const View& view = views[i];
    cameras[i] = {.fx = view.fx, .fy = view.fy, .cx = view.cx, .cy = view.cy};
    std::copy_n(view.scene_from_camera.begin(), 12, cameras[i].scene_from_camera);
  }
  const Tensor packed = pixels.contiguous();
  const auto options = pixels.options().dtype(type);
  Rays rays{at::empty({pixels.size(0), 3}, options), at::empty({pixels.size(0), 3}, options)};
  WithScalar(type, [&](auto scalar) {
    using Scalar = decltype(scalar);
    CameraRaysCpu(CameraRaysArgs<Scalar>{.n_rays = pixels.size(0),
                                         .cameras = cameras.data(),
                                         .pixels = In<int32_t>(packed),
                                         .origins = Out<Scalar>(rays.origins),
                                         .directions = Out<Scalar>(rays.directions)});
  });
  return rays;
}

Samples MarchRays(const OccupancyGrid& occupancy, const SceneMap& map, const Rays& rays, const RenderOptions& options) {
  CheckOptions(options);
  const Tensor origins = rays.origins.contiguous(), directions = rays.directions.contiguous();
  const int64_t n_rays = origins.size(0);
  const auto indices = origins.options().dtype(torch::kLong);
  Samples samples;
  samples.ray_offsets = at::empty({n_rays + 1}, indices);
  WithScalar(origins.scalar_type(), [&](auto scalar) {
    using Scalar = decltype(scalar);
    MarchArgs<Scalar> args{.n_rays = n_rays,
                           .origins = In<Scalar>(origins),
                           .directions = In<Scalar>(directions),
                           .occupancy = occupancy.bits(),
                           .map = map,
                           .step = options.step,
                           .near = options.near,
                           .far = options.far};
    if (options.jitter) {
      args.jitter = true;
      args.jitter_seed = options.jitter->first;
      args.jitter_stream = StreamAt(options.jitter_purpose, options.jitter->second);
    }
    const int64_t n_samples = CountSamplesCpu(args, Out<int64_t>(samples.ray_offsets));
    samples.t = at::empty({n_samples}, origins.options());
    samples.delta = at::empty({n_samples}, origins.options());
    samples.points = at::empty({n_samples, 3}, origins.options());
    samples.ray_index = at::empty({n_samples}, indices);
    FillSamplesCpu(args, In<int64_t>(samples.ray_offsets),
                   SampleArrays<Scalar>{.t = Out<Scalar>(samples.t),
                                        .delta = Out<Scalar>(samples.delta),
                                        .points = Out<Scalar>(samples.points),
                                        .ray_index = Out<int64_t>(samples.ray_index)});
  });
  return samples;
}

RenderResult RenderRays(const RadianceField& field, const OccupancyGrid& occupancy, const SceneMap& map,
                        const Rays& rays, const RenderOptions& options) {
  return RenderSamples(field, MarchRays(occupancy, map, rays, options), rays, options);
}

Visibility MeasureVisibility(const RadianceField& field, const Samples& samples, double stop_transmittance) {
  const Tensor sigma = samples.t.numel() > 0 ? field.Density(samples.points) : at::empty_like(samples.t);
  const tensor_list weights = Weights::apply(sigma, samples.delta, samples.ray_offsets, stop_transmittance);
  return {sigma, weights[0], weights[1]};
}

RenderResult RenderSamples(const RadianceField& field, const Samples& samples, const Rays& rays,
                           const RenderOptions& options) {
  const Visibility visibility = MeasureVisibility(field, samples, options.stop_transmittance);
  const Tensor &weights = visibility.weights, &transmittance = visibility.transmittance;
  RenderResult result;
  result.n_samples = samples.t.numel();
  result.delta = samples.delta;
  result.sigma = visibility.sigma;
  result.weights = weights;

  const Selection shaded = SelectSamples(weights, samples.ray_offsets, options.weight_threshold);
  result.n_shaded = shaded.indices.numel();
  result.shaded_weights = weights.index_select(0, shaded.indices);
  result.shaded_directions = rays.directions.index_select(0, samples.ray_index.index_select(0, shaded.indices));
  RadianceField::Shading shading;
  if (result.n_shaded > 0) {
    shading = field.Shade(samples.points.index_select(0, shaded.indices), result.shaded_directions);
  } else {
    shading = {at::empty_like(result.shaded_directions), at::empty_like(result.shaded_directions)};
  }
  result.shaded_normals = shading.normal;

  result.rgb = Accumulate::apply(result.shaded_weights, shading.rgb, shaded.ray_offsets) +
               transmittance.unsqueeze(1) * options.background;
  result.normal = Accumulate::apply(result.shaded_weights, shading.normal, shaded.ray_offsets);
  result.depth = Accumulate::apply(weights.detach(), samples.t.unsqueeze(1), samples.ray_offsets).squeeze(1);
  result.opacity = 1 - transmittance;
  return result;
}

}  // namespace nrff
