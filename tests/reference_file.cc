#include "tests/reference_file.h"

#include <ATen/ATen.h>

#include <algorithm>
#include <stdexcept>

namespace nrff::testing {

using torch::Tensor;

Tensor ReadTensor(const SafetensorsFile& file, const std::string& name) {
  const SafetensorsFile::Tensor& stored = file.Get(name);
  const auto read = [&](auto scalar, torch::Dtype type) {
    const auto values = file.Values<decltype(scalar)>(name);
    return at::from_blob(const_cast<decltype(scalar)*>(values.data()), stored.shape, type).clone();
  };
  switch (stored.dtype) {
    case DType::kF32:
      return read(float{}, torch::kFloat).to(torch::kDouble);
    case DType::kF64:
      return read(double{}, torch::kDouble);
    case DType::kI64:
      return read(int64_t{}, torch::kLong).to(torch::kDouble);
    case DType::kU8:
      break;
  }
  return read(uint8_t{}, torch::kByte).to(torch::kBool);
}

std::map<std::string, Tensor> ReadTensors(const SafetensorsFile& file, const std::string& prefix) {
  std::map<std::string, Tensor> tensors;
  for (const auto& [name, stored] : file.tensors()) {
    if (name.starts_with(prefix)) tensors.emplace(name.substr(prefix.size()), ReadTensor(file, name));
  }
  return tensors;
}

OracleSettings ReadOracleSettings(const SafetensorsFile& file) {
  OracleSettings settings;
  settings.levels = std::stoi(file.Metadata("levels"));
  settings.lobes_theta = int(file.Get("shading/lobe_axis").shape.at(0));
  settings.density_shift = std::stod(file.Metadata("density_shift"));
  settings.distance_scale = std::stod(file.Metadata("distance_scale"));
  settings.weight_threshold = std::stod(file.Metadata("weight_threshold"));
  settings.background = file.Metadata("background") == "white" ? 1 : 0;
  return settings;
}

FieldConfig ReadFieldConfig(const SafetensorsFile& file) {
  const auto shape = [&](const std::string& name) { return file.Get("param/" + name).shape; };
  const auto layers = [&](const std::string& mlp) {
    int n = 0;
    while (file.Has("param/rendering_net." + mlp + "." + std::to_string(2 * n) + ".weight")) ++n;
    return n;
  };
  FieldConfig config;
  config.levels = std::stoi(file.Metadata("levels"));
  config.base_resolution = std::stoi(file.Metadata("base_resolution"));
  config.max_resolution = std::stoi(file.Metadata("max_resolution"));
  config.density_channels = int(shape("density_field.tensors.0.plane_xy").at(1));
  config.appearance_channels = int(shape("appearance_field.tensors.0.plane_xy").at(1));
  config.density_scale = std::stod(file.Metadata("distance_scale"));
  config.density_shift = std::stod(file.Metadata("density_shift"));
  config.spatial_layers = layers("spatial_mlp");
  config.spatial_width = int(shape("rendering_net.spatial_mlp.0.weight").at(0));
  config.bottleneck_width = int(file.Get("shading/bottleneck").shape.at(1));
  config.lobes_theta = int(file.Get("shading/lobe_axis").shape.at(0));
  config.lobes_phi = int(file.Get("shading/lobe_axis").shape.at(1));
  config.lobe_row_width = int(shape("rendering_net.asg_mlp.0.weight").at(1));
  config.directional_layers = layers("directional_mlp");
  config.directional_width = int(shape("rendering_net.directional_mlp.0.weight").at(0));
  config.activation = Activation::kGelu;
  return config;
}

namespace {

// "spatial_mlp.2.weight" → "rendering_net.spatial_mlp.4.weight"; "lobes.bias" → "rendering_net.asg_mlp.0.bias".
std::string AuthorsName(const std::string& name) {
  const size_t first = name.find('.'), last = name.rfind('.');
  const std::string network = name.substr(0, first), what = name.substr(last);
  if (network == "lobes") return "rendering_net.asg_mlp.0" + what;
  return "rendering_net." + network + "." + std::to_string(2 * std::stoi(name.substr(first + 1, last - first - 1))) +
         what;
}

}  // namespace

void ForEachPart(const NrffField& field, const std::vector<Tensor>& values,
                 const std::function<void(const std::string&, const Tensor&)>& visit) {
  for (size_t i = 0; i < values.size(); ++i) {
    const NrffField::Parameter& parameter = field.parameters()[i];
    if (!parameter.is_grid) {
      visit(AuthorsName(parameter.name), values[i]);
      continue;
    }
    const bool density = parameter.name == "density_grid";
    const GridLayout& layout = density ? field.density_layout() : field.appearance_layout();
    const int64_t n_channels = layout.n_channels;
    for (size_t l = 0; l < layout.levels.size(); ++l) {
      const GridLayout::Level& level = layout.levels[l];
      const int64_t n = level.resolution;
      const std::string prefix =
          std::string(density ? "density" : "appearance") + "_field.tensors." + std::to_string(l) + ".";
      for (int p = 0; p < 3; ++p) {
        const Tensor plane = values[i].narrow(0, level.plane_offsets[p], n * n * n_channels).view({n, n, n_channels});
        visit(prefix + kGridProducts[p].plane_name, plane.permute({2, 0, 1}).unsqueeze(0));
        const Tensor line = values[i].narrow(0, level.line_offsets[p], n * n_channels).view({n, n_channels});
        visit(prefix + kGridProducts[p].line_name, line.t().unsqueeze(0).unsqueeze(3));
      }
    }
  }
}

}  // namespace nrff::testing
