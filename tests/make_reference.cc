// Writes the small reference that travels with the project: make_reference tests/data/nrff_reference_small.safetensors
//
// Values of the oracle (tests/oracle.h) in double for a small model with parameters drawn once, in the form that
// tests/reference_test.cc describes. The oracle itself is held against the authors' values there.

#include <ATen/ATen.h>

#include <cstdio>
#include <numbers>

#include "model/nrff_field.h"
#include "model/safetensors.h"
#include "render/kernels/random.h"
#include "tests/reference_file.h"
#include "tests/reference_models.h"

namespace nrff::testing {
namespace {

using torch::Tensor;

constexpr uint64_t kSeed = 7;

// Uniform in [low, high), exactly representable as float.
Tensor Draw(uint64_t stream, const std::vector<int64_t>& shape, double low, double high) {
  Tensor tensor = at::empty(shape, torch::kDouble);
  for (int64_t i = 0; i < tensor.numel(); ++i) {
    tensor.mutable_data_ptr<double>()[i] = float(low + (high - low) * double(Uniform(kSeed, stream, i)));
  }
  return tensor;
}

class ReferenceWriter {
 public:
  void Add(const std::string& name, const Tensor& value, torch::Dtype type = torch::kDouble) {
    values_[name] = value.detach().to(type).contiguous();
  }
  void Write(const std::filesystem::path& path, const std::map<std::string, std::string>& metadata) const {
    std::vector<TensorToWrite> tensors;
    for (const auto& [name, value] : values_) {
      const DType type = value.scalar_type() == torch::kDouble  ? DType::kF64
                         : value.scalar_type() == torch::kFloat ? DType::kF32
                                                                : DType::kU8;
      tensors.push_back({name, type, value.sizes().vec(), value.const_data_ptr()});
    }
    WriteSafetensors(path, tensors, metadata);
  }

 private:
  std::map<std::string, Tensor> values_;
};

const std::map<std::string, std::string> kMetadata = {{"levels", "2"},
                                                      {"base_resolution", "4"},
                                                      {"max_resolution", "6"},
                                                      {"density_shift", "-4"},
                                                      {"distance_scale", "25"},
                                                      {"near", "0.5"},
                                                      {"far", "6.0"},
                                                      {"weight_threshold", "1e-3"},
                                                      {"background", "white"},
                                                      {"lr_grid", "0.02"},
                                                      {"lr_mlp", "0.001"},
                                                      {"betas", "0.9,0.99"},
                                                      {"produced_by", "tests/make_reference.cc"}};

FieldConfig SmallConfig() {
  FieldConfig config;
  config.levels = 2;
  config.base_resolution = 4;
  config.max_resolution = 6;
  config.spatial_layers = 3;
  config.spatial_width = 12;
  config.bottleneck_width = 5;
  config.lobes_theta = 3;
  config.lobes_phi = 4;
  config.lobe_row_width = 6;
  config.directional_layers = 3;
  config.directional_width = 12;
  return config;
}

// Parameters, rays and points; all else follows from them.
void AddInputs(ReferenceWriter& out) {
  const NrffField field(SmallConfig(), torch::kDouble, kSeed);
  std::vector<Tensor> values;
  uint64_t stream = 100;
  for (const auto& parameter : field.parameters()) {
    // Grids large enough that the field has both empty and opaque places.
    values.push_back(parameter.is_grid ? Draw(stream++, parameter.value.sizes().vec(), -1.2, 1.2) : parameter.value);
  }
  ForEachPart(field, values,
              [&](const std::string& name, const Tensor& part) { out.Add("param/" + name, part, torch::kFloat); });

  Tensor points = Draw(1, {24, 3}, -1, 1);
  for (int k = 0; k < 3; ++k) {  // corners and an edge
    points[20][k] = -1;
    points[21][k] = 1;
    points[22][k] = k == 0 ? 1 : -1;
  }
  out.Add("encoding/points", points);
  out.Add("encoding/upstream_density_feature", Draw(2, {24}, -1, 1));
  out.Add("encoding/upstream_appearance_feature", Draw(3, {24, field.appearance_layout().n_features()}, -1, 1));
  const Tensor view = Draw(4, {24, 3}, -1, 1);
  out.Add("shading/view_direction", view / view.norm(2, {1}, true));

  constexpr int64_t kRays = 12, kSamples = 20;
  constexpr double kStep = 0.13;
  const Tensor aabb = at::tensor({-1.2, -1., -0.8, 1.1, 1.3, 0.9}, torch::kDouble).view({2, 3});
  const Tensor angle = Draw(5, {kRays, 2}, 0, 1);
  const Tensor azimuth = 2 * std::numbers::pi * angle.select(1, 0), height = 1.4 * angle.select(1, 1) - 0.7;
  const Tensor origins = 3 * at::stack({azimuth.cos(), azimuth.sin(), height}, 1);
  const Tensor towards = Draw(6, {kRays, 3}, -0.5, 0.5) - origins;
  const Tensor directions = towards / towards.norm(2, {1}, true);
  const Tensor t = 2 + kStep * at::arange(kSamples, torch::kDouble).unsqueeze(0) + Draw(8, {kRays, 1}, 0, kStep);
  const Tensor scene = origins.unsqueeze(1) + t.unsqueeze(2) * directions.unsqueeze(1);
  const Tensor inside = ((scene >= aabb[0]) & (scene <= aabb[1])).all(2);
  out.Add("render/aabb", aabb);
  out.Add("render/rays", at::cat({origins, directions}, 1));
  out.Add("render/t", t);
  out.Add("render/inside", inside, torch::kByte);
  out.Add("render/target", Draw(7, {kRays, 3}, 0, 1));
}

// What the oracle makes of the inputs in `file`; `lobes` sizes are read from it too.
void AddResults(const SafetensorsFile& file, ReferenceWriter& out) {
  const auto model = MakeReferenceModel(ModelKind::kOracle, file);
  const Tensor points = ReadTensor(file, "encoding/points");
  const Tensor density = model->DensityFeature(points), appearance = model->AppearanceFeature(points);
  out.Add("encoding/density_feature", density);
  out.Add("encoding/density", model->DensityOverScale(density));
  out.Add("encoding/appearance_feature", appearance);
  ((density * ReadTensor(file, "encoding/upstream_density_feature")).sum() +
   (appearance * ReadTensor(file, "encoding/upstream_appearance_feature")).sum())
      .backward();
  for (const auto& [name, gradient] : model->Gradients()) {
    if (gradient.defined()) out.Add("encoding/grad/" + name, gradient, torch::kFloat);
  }
  for (const auto& [name, value] : model->Shade(appearance, ReadTensor(file, "shading/view_direction"))) {
    out.Add("shading/" + name, value);
  }

  const auto fresh = MakeReferenceModel(ModelKind::kOracle, file);
  const RenderInput input = ReadRenderInput(file);
  const RenderedReference rendered = fresh->Render(input);
  out.Add("render/density", rendered.density);
  out.Add("render/weight", rendered.weight);
  out.Add("render/background_weight", rendered.background_weight);
  out.Add("render/rgb", rendered.rgb);
  out.Add("render/depth", rendered.depth);
  out.Add("loss/mse", rendered.losses.mse.view({1}));
  out.Add("loss/normal_orientation", rendered.losses.orientation.view({1}));
  out.Add("loss/density_l1", rendered.losses.density_l1.view({1}));
  out.Add("loss/total", rendered.losses.Total().view({1}));
  rendered.losses.Total().backward();
  for (const auto& [name, gradient] : fresh->Gradients()) out.Add("grad/" + name, gradient, torch::kFloat);

  std::vector<double> losses{rendered.losses.Total().item<double>()};
  for (int step = 1; step < 10; ++step) {
    fresh->AdamStep(step, std::stod(kMetadata.at("lr_grid")), std::stod(kMetadata.at("lr_mlp")));
    const Tensor total = fresh->Render(input).losses.Total();
    losses.push_back(total.item<double>());
    total.backward();
  }
  out.Add("adam/loss", at::tensor(losses, torch::kDouble));
  std::printf("%lld shaded samples, opacity %.3f\n",
              static_cast<long long>((rendered.weight > input.weight_threshold).sum().item<int64_t>()),
              1 - rendered.background_weight.mean().item<double>());
}

void MakeReference(const std::filesystem::path& path) {
  ReferenceWriter out;
  AddInputs(out);
  // Sizes that readers take from shading/… tensors; AddResults fills them.
  const FieldConfig config = SmallConfig();
  out.Add("shading/lobe_axis", at::zeros({config.lobes_theta, config.lobes_phi, 3}, torch::kDouble));
  out.Add("shading/bottleneck", at::zeros({24, config.bottleneck_width}, torch::kDouble));
  out.Write(path, kMetadata);
  AddResults(SafetensorsFile(path), out);
  out.Write(path, kMetadata);
}

}  // namespace
}  // namespace nrff::testing

int main(int argc, char** argv) {
  if (argc != 2) {
    std::fprintf(stderr, "usage: make_reference FILE\n");
    return 2;
  }
  nrff::testing::MakeReference(argv[1]);
  return 0;
}
