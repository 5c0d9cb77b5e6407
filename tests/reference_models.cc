#include "tests/reference_models.h"

#include <ATen/ATen.h>
#include <c10/core/GradMode.h>

#include <cmath>

#include "model/kernels/adam.h"
#include "model/losses.h"
#include "render/volume_renderer.h"
#include "tests/oracle.h"
#include "tests/reference_file.h"

namespace nrff::testing {
namespace {

using torch::Tensor;

constexpr double kBeta1 = 0.9, kBeta2 = 0.99, kEpsilon = 1e-8;

bool IsGrid(const std::string& authors_name) { return authors_name.find("_field.tensors.") != std::string::npos; }

class OracleModel : public ReferenceModel {
 public:
  explicit OracleModel(const SafetensorsFile& file)
      : oracle_(LeavesOf(ReadTensors(file, "param/")), ReadOracleSettings(file)) {}

  Tensor DensityFeature(const Tensor& points) override { return oracle_.DensityFeature(points); }
  Tensor DensityOverScale(const Tensor& feature) override { return oracle_.Density(feature); }
  Tensor AppearanceFeature(const Tensor& points) override { return oracle_.AppearanceFeature(points); }

  std::map<std::string, Tensor> Shade(const Tensor& feature, const Tensor& view_direction) override {
    const Oracle::Shading s = oracle_.Shade(feature, view_direction);
    return {{"diffuse", s.diffuse},
            {"tint", s.tint},
            {"normal", s.normal},
            {"bottleneck", s.bottleneck},
            {"asg_feature", s.asg_feature},
            {"asg_a", s.asg_a},
            {"asg_lambda_raw", s.asg_lambda_raw},
            {"asg_mu_raw", s.asg_mu_raw},
            {"reflected_direction", s.reflected_direction},
            {"encoding", s.encoding},
            {"rgb", s.rgb},
            {"lobe_axis", s.lobe_axis},
            {"lobe_axis_lambda", s.lobe_axis_lambda},
            {"lobe_axis_mu", s.lobe_axis_mu}};
  }

  RenderedReference Render(const RenderInput& in) override {
    const Oracle::Rendering r = oracle_.Render(in.rays, in.t, in.inside, in.aabb);
    return {r.density, r.weight, r.background_weight,
            r.rgb,     r.depth,  {(r.rgb - in.target).square().mean(), r.orientation_loss, oracle_.DensityL1()}};
  }

  std::map<std::string, Tensor> Gradients() override {
    std::map<std::string, Tensor> gradients;
    for (const auto& [name, value] : oracle_.parameters()) gradients[name] = value.grad();
    return gradients;
  }

  void AdamStep(int t, double grid_rate, double network_rate) override {
    const c10::NoGradGuard no_grad;
    for (const auto& [name, value] : oracle_.parameters()) {
      Tensor &m = m_[name], &v = v_[name];
      const Tensor g = value.grad();
      m = m.defined() ? kBeta1 * m + (1 - kBeta1) * g : (1 - kBeta1) * g;
      v = v.defined() ? kBeta2 * v + (1 - kBeta2) * g * g : (1 - kBeta2) * g * g;
      const Tensor m_hat = m / (1 - std::pow(kBeta1, t)), v_hat = v / (1 - std::pow(kBeta2, t));
      Tensor parameter = value;
      parameter.sub_((IsGrid(name) ? grid_rate : network_rate) * m_hat / (v_hat.sqrt() + kEpsilon));
      parameter.mutable_grad() = Tensor();
    }
  }

 private:
  static std::map<std::string, Tensor> LeavesOf(std::map<std::string, Tensor> tensors) {
    for (auto& [name, tensor] : tensors) tensor.requires_grad_(true);
    return tensors;
  }

  Oracle oracle_;
  std::map<std::string, Tensor> m_, v_;
};

class FieldModel : public ReferenceModel {
 public:
  FieldModel(const SafetensorsFile& file, torch::Dtype type) : field_(ReadFieldConfig(file), type, 0) {
    const c10::NoGradGuard no_grad;
    const std::map<std::string, Tensor> parameters = ReadTensors(file, "param/");
    std::vector<Tensor> values;
    for (const NrffField::Parameter& parameter : field_.parameters()) {
      values.push_back(parameter.value.detach());
      m_.push_back(at::zeros_like(parameter.value));
      v_.push_back(at::zeros_like(parameter.value));
    }
    ForEachPart(field_, values, [&](const std::string& name, const Tensor& part) { part.copy_(parameters.at(name)); });
  }

  Tensor DensityFeature(const Tensor& points) override { return field_.DensityFeature(points); }
  Tensor DensityOverScale(const Tensor& feature) override {
    return field_.DensityFromFeature(feature) / field_.config().density_scale;
  }
  Tensor AppearanceFeature(const Tensor& points) override { return field_.AppearanceFeature(points); }

  std::map<std::string, Tensor> Shade(const Tensor& feature, const Tensor& view_direction) override {
    const NrffField::ShadingParts s = field_.ShadeFeature(feature.to(field_.type()), view_direction);
    const FieldConfig& config = field_.config();
    const Tensor raw = s.lobe_parameters.view({feature.size(0), config.lobes_theta, config.lobes_phi, kLobeParameters});
    return {{"diffuse", s.diffuse},
            {"tint", s.tint},
            {"normal", s.normal},
            {"bottleneck", s.bottleneck},
            {"asg_feature", s.encoding_share},
            {"asg_a", raw.slice(3, 0, 2)},
            {"asg_lambda_raw", raw.slice(3, 2, 3)},
            {"asg_mu_raw", raw.slice(3, 3, 4)},
            {"reflected_direction", s.reflected_direction},
            {"encoding", s.encoding},
            {"rgb", s.rgb}};
  }

  // The renderer on the file's samples, packed: those inside the box.
  RenderedReference Render(const RenderInput& in) override {
    const Rays rays{in.rays.slice(1, 0, 3).to(field_.type()), in.rays.slice(1, 3, 6).to(field_.type())};
    const Tensor scene = in.rays.slice(1, 0, 3).unsqueeze(1) + in.t.unsqueeze(2) * in.rays.slice(1, 3, 6).unsqueeze(1);
    const Tensor points = 2 * (scene - in.aabb[0]) / (in.aabb[1] - in.aabb[0]) - 1;
    const Tensor delta = at::cat({in.t.slice(1, 1) - in.t.slice(1, 0, -1), at::zeros_like(in.t.slice(1, 0, 1))}, 1);
    const auto pack = [&](const Tensor& values) { return values.index({in.inside}).to(field_.type()).contiguous(); };
    Samples samples;
    samples.ray_offsets = at::cat({at::zeros({1}, torch::kLong), in.inside.sum(1).cumsum(0)});
    samples.ray_index = in.inside.nonzero().select(1, 0).contiguous();
    samples.t = pack(in.t);
    samples.delta = pack(delta);
    samples.points = pack(points);
    RenderOptions options;
    options.weight_threshold = in.weight_threshold;
    options.stop_transmittance = 0;
    options.background = in.background;
    const RenderResult r = RenderSamples(field_, samples, rays, options);

    const auto unpack = [&](const Tensor& values) {
      return at::zeros_like(in.t).masked_scatter(in.inside, values.detach().to(torch::kDouble));
    };
    RenderedReference out;
    out.density = unpack(r.sigma / field_.config().density_scale);
    out.weight = unpack(r.weights);
    out.background_weight = 1 - r.opacity;
    out.rgb = r.rgb;
    out.depth = r.depth + (1 - r.opacity) * rays.directions.select(1, 2);  // the authors' far end
    out.losses = {MseLoss(r.rgb, in.target.to(field_.type())),
                  OrientationLoss(r.shaded_weights, r.shaded_normals, r.shaded_directions), field_.DensityL1()};
    return out;
  }

  std::map<std::string, Tensor> Gradients() override {
    std::vector<Tensor> values;
    for (const NrffField::Parameter& parameter : field_.parameters()) {
      const Tensor gradient = parameter.value.grad();
      values.push_back(gradient.defined() ? gradient : at::zeros_like(parameter.value));
    }
    std::map<std::string, Tensor> gradients;
    ForEachPart(field_, values, [&](const std::string& name, const Tensor& part) { gradients[name] = part; });
    return gradients;
  }

  void AdamStep(int t, double grid_rate, double network_rate) override {
    if (field_.type() == torch::kDouble) {
      AdamStepAs<double>(t, grid_rate, network_rate);
    } else {
      AdamStepAs<float>(t, grid_rate, network_rate);
    }
  }

 private:
  template <typename Scalar>
  void AdamStepAs(int t, double grid_rate, double network_rate) {
    for (size_t i = 0; i < m_.size(); ++i) {
      const NrffField::Parameter& parameter = field_.parameters()[i];
      const AdamOptions options{.learning_rate = parameter.is_grid ? grid_rate : network_rate,
                                .beta1 = kBeta1,
                                .beta2 = kBeta2,
                                .epsilon = kEpsilon};
      const Tensor gradient = parameter.value.grad().contiguous();
      nrff::AdamStep(options, t, gradient.numel(), gradient.const_data_ptr<Scalar>(),
                     parameter.value.mutable_data_ptr<Scalar>(), m_[i].mutable_data_ptr<Scalar>(),
                     v_[i].mutable_data_ptr<Scalar>());
      parameter.value.mutable_grad() = Tensor();
    }
  }

  NrffField field_;
  std::vector<Tensor> m_, v_;
};

}  // namespace

RenderInput ReadRenderInput(const SafetensorsFile& file) {
  const OracleSettings settings = ReadOracleSettings(file);
  return {ReadTensor(file, "render/rays"),
          ReadTensor(file, "render/t"),
          ReadTensor(file, "render/inside"),
          ReadTensor(file, "render/aabb"),
          ReadTensor(file, "render/target"),
          settings.weight_threshold,
          settings.background};
}

std::unique_ptr<ReferenceModel> MakeReferenceModel(ModelKind kind, const SafetensorsFile& file) {
  if (kind == ModelKind::kOracle) return std::make_unique<OracleModel>(file);
  return std::make_unique<FieldModel>(file, kind == ModelKind::kFieldDouble ? torch::kDouble : torch::kFloat);
}

}  // namespace nrff::testing
