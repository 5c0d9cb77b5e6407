#include "tests/oracle.h"

#include <ATen/ATen.h>

#include <numbers>
#include <stdexcept>

namespace nrff::testing {

using torch::Tensor;

Oracle::Oracle(std::map<std::string, Tensor> parameters, OracleSettings settings)
    : parameters_(std::move(parameters)), settings_(settings) {}

Tensor Oracle::At(const std::string& name) const {
  const auto it = parameters_.find(name);
  if (it == parameters_.end()) throw std::out_of_range("no parameter " + name);
  return it->second;
}

Tensor Oracle::Products(const std::string& field, int level, const Tensor& points) const {
  constexpr int64_t kBilinear = 0, kZeros = 0;
  const std::string prefix = field + "_field.tensors." + std::to_string(level) + ".";
  const Tensor x = points.select(1, 0), y = points.select(1, 1), z = points.select(1, 2), nil = at::zeros_like(x);
  const auto sample = [&](const char* name, const Tensor& column, const Tensor& row) {
    const Tensor grid = at::stack({column, row}, 1).view({1, -1, 1, 2});
    return at::grid_sampler_2d(At(prefix + name), grid, kBilinear, kZeros, /*align_corners=*/true)
        .squeeze(3)
        .squeeze(0);
  };
  return at::stack({sample("plane_yz", y, z) * sample("line_x", nil, x),
                    sample("plane_xz", x, z) * sample("line_y", nil, y),
                    sample("plane_xy", x, y) * sample("line_z", nil, z)});
}

Tensor Oracle::DensityFeature(const Tensor& points) const {
  Tensor sum = at::zeros({points.size(0)}, points.options());
  for (int level = 0; level < settings_.levels; ++level)
    sum = sum + Products("density", level, points).flatten(0, 1).sum(0);
  return sum;
}

Tensor Oracle::Density(const Tensor& feature) const {
  const Tensor x = feature + settings_.density_shift;
  return x.clamp_min(0) + at::log1p((-x.abs()).exp());
}

Tensor Oracle::AppearanceFeature(const Tensor& points) const {
  std::vector<Tensor> levels;
  levels.reserve(size_t(settings_.levels));
  for (int level = 0; level < settings_.levels; ++level) {
    levels.push_back(Products("appearance", level, points).flatten(0, 1).t());
  }
  return at::cat(levels, 1);
}

// Linear layers are numbered 0, 2, 4, … with activations between.
Tensor Oracle::Mlp(const std::string& name, Tensor x) const {
  for (int i = 0;; i += 2) {
    const std::string layer = "rendering_net." + name + "." + std::to_string(i);
    x = at::matmul(x, At(layer + ".weight").t()) + At(layer + ".bias");
    if (!parameters_.count("rendering_net." + name + "." + std::to_string(i + 2) + ".weight")) return x;
    x = 0.5 * x * (1 + at::erf(x / std::numbers::sqrt2));
  }
}

Oracle::Shading Oracle::Shade(const Tensor& appearance_feature, const Tensor& view_direction) const {
  const int64_t n = appearance_feature.size(0);
  const Tensor row_weight = At("rendering_net.asg_mlp.0.weight");
  const int64_t n_phi = row_weight.size(0) / 4, row_width = row_weight.size(1);

  Shading s;
  const Tensor spatial = Mlp("spatial_mlp", appearance_feature);
  const int64_t n_theta = settings_.lobes_theta;
  const int64_t n_bottleneck = spatial.size(1) - 9 - n_theta * row_width;
  s.diffuse = spatial.slice(1, 0, 3);
  s.tint = spatial.slice(1, 3, 6);
  const Tensor normal = spatial.slice(1, 6, 9);
  s.normal = -normal / normal.square().sum(1, true).sqrt();
  s.bottleneck = spatial.slice(1, 9, 9 + n_bottleneck);
  s.asg_feature = spatial.slice(1, 9 + n_bottleneck);

  const Tensor raw =
      (at::matmul(s.asg_feature.reshape({n, n_theta, row_width}), row_weight.t()) + At("rendering_net.asg_mlp.0.bias"))
          .view({n, n_theta, n_phi, 4});
  s.asg_a = raw.slice(3, 0, 2);
  s.asg_lambda_raw = raw.slice(3, 2, 3);
  s.asg_mu_raw = raw.slice(3, 3, 4);

  const auto options = appearance_feature.options();
  const std::vector<Tensor> angles = at::meshgrid(
      {at::linspace(0, std::numbers::pi, n_theta, options), at::linspace(0, 2 * std::numbers::pi, n_phi, options)},
      "ij");
  const Tensor &theta = angles[0], &phi = angles[1];
  s.lobe_axis = at::stack({theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()}, 2);
  s.lobe_axis_lambda = at::stack({theta.cos() * phi.cos(), theta.cos() * phi.sin(), -theta.sin()}, 2);
  s.lobe_axis_mu = at::stack({-phi.sin(), phi.cos(), at::zeros_like(phi)}, 2);

  const Tensor wo = -view_direction;
  const Tensor cosine = (wo * s.normal).sum(1, true);
  s.reflected_direction = 2 * cosine * s.normal - wo;
  const auto dot = [&](const Tensor& axis) {
    return (s.reflected_direction.view({n, 1, 1, 3}) * axis.unsqueeze(0)).sum(3, true);
  };
  const auto softplus = [](const Tensor& x) { return x.clamp_min(0) + at::log1p((-x.abs()).exp()); };
  const Tensor exponent = softplus(s.asg_lambda_raw - 1) * dot(s.lobe_axis_lambda).square() +
                          softplus(s.asg_mu_raw - 1) * dot(s.lobe_axis_mu).square();
  s.encoding = (s.asg_a * dot(s.lobe_axis).clamp_min(0) * (-exponent).exp()).reshape({n, -1});

  const Tensor specular = Mlp("directional_mlp", at::cat({s.bottleneck, s.encoding, cosine}, 1));
  s.rgb = 1 / (1 + (-(s.diffuse + s.tint * specular)).exp());
  return s;
}

Oracle::Rendering Oracle::Render(const Tensor& rays, const Tensor& t, const Tensor& inside, const Tensor& aabb) const {
  const Tensor origins = rays.slice(1, 0, 3).unsqueeze(1), directions = rays.slice(1, 3, 6).unsqueeze(1);
  const Tensor scene = origins + t.unsqueeze(2) * directions;
  const Tensor points = 2 * (scene - aabb[0]) / (aabb[1] - aabb[0]) - 1;

  Rendering r;
  r.density = at::zeros_like(t).masked_scatter(inside, Density(DensityFeature(points.index({inside}))));
  const Tensor delta = at::cat({t.slice(1, 1) - t.slice(1, 0, -1), at::zeros_like(t.slice(1, 0, 1))}, 1);
  const Tensor alpha = 1 - (-r.density * delta * settings_.distance_scale).exp();
  const Tensor ones = at::ones_like(t.slice(1, 0, 1));
  const Tensor transmittance = at::cumprod(at::cat({ones, 1 - alpha + 1e-10}, 1), 1);  // the authors' small term
  r.weight = alpha * transmittance.slice(1, 0, -1);
  r.background_weight = transmittance.slice(1, -1);

  const Tensor shaded = r.weight > settings_.weight_threshold;
  const Tensor shaded_directions = directions.expand_as(points).index({shaded});
  const Shading shading = Shade(AppearanceFeature(points.index({shaded})), shaded_directions);
  const Tensor colour = at::zeros_like(points).masked_scatter(shaded.unsqueeze(2).expand_as(points), shading.rgb);
  const Tensor opacity = r.weight.sum(1, true);
  r.rgb = (r.weight.unsqueeze(2) * colour).sum(1) + (1 - opacity) * settings_.background;
  // The authors add the direction's z where the far distance was meant.
  r.depth = (r.weight * t).sum(1) + (1 - opacity.squeeze(1)) * rays.select(1, 5);
  const Tensor facing_away = (shading.normal * shaded_directions).sum(1).clamp_min(0);
  r.orientation_loss = (r.weight.index({shaded}) * facing_away.square()).mean();
  return r;
}

Tensor Oracle::DensityL1() const {
  std::vector<Tensor> means;
  for (const auto& [name, value] : parameters_) {
    if (name.starts_with("density_field.")) means.push_back(value.abs().mean());
  }
  return at::stack(means).mean();
}

}  // namespace nrff::testing
