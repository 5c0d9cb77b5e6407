#include "model/cuda/gpu_model.h"

#include <algorithm>

namespace nrff {

GpuModel MakeGpuModel(const NrffField& field) {
  const FieldConfig& config = field.config();
  if (config.directional_encoding != DirectionalEncoding::kRee &&
      config.directional_encoding != DirectionalEncoding::kNone) {
    throw InputError(std::string("the model's directional encoding is ") +
                     kDirectionalEncodings[static_cast<int>(config.directional_encoding)] +
                     ", of which the GPU has only ree and none; use --device cpu");
  }
  constexpr int64_t kAlignment = 64;  // elements
  GpuModel model;
  model.density = field.density_layout();
  model.appearance = field.appearance_layout();
  model.density_scale = float(config.density_scale);
  model.density_shift = float(config.density_shift);
  model.decodes = config.decoded_features > 0;
  model.encoding = config.directional_encoding;
  model.bottleneck_width = config.bottleneck_width;
  model.activation = config.activation;
  model.corrected_views = config.corrected_views;
  for (const NrffField::Parameter& parameter : field.parameters()) {
    model.segments.push_back({model.n_parameters, parameter.value.numel()});
    model.n_parameters += (parameter.value.numel() + kAlignment - 1) / kAlignment * kAlignment;
    if (parameter.is_grid) model.n_grid = model.n_parameters;
  }
  model.corrections = config.corrected_views > 0 ? model.segments.back().begin : model.n_parameters;
  // Layers follow the grids, each a weight and a bias: the order of NrffField's parameters.
  size_t next = 2;
  const auto layer = [&](const LinearLayer& linear) {
    const GpuModel::Layer made{linear.n_in, linear.n_out, model.segments[next].begin, model.segments[next + 1].begin};
    next += 2;
    return made;
  };
  const ShadingNetworks networks = field.Networks();
  for (const LinearLayer& linear : networks.spatial) model.spatial.push_back(layer(linear));
  if (model.encoding == DirectionalEncoding::kRee) {
    model.lobe_layer = layer(networks.lobe_layer);
    model.lobes = networks.lobes;
  }
  for (const LinearLayer& linear : networks.directional) model.directional.push_back(layer(linear));
  return model;
}

std::vector<device::GpuView> MakeGpuViews(const PixelSource& pixels) {
  std::vector<device::GpuView> views;
  int64_t first_row = 0;
  for (const View& view : pixels.views()) {
    device::GpuView gpu;
    gpu.camera = {view.fx, view.fy, view.cx, view.cy, {}};
    gpu.width = view.width;
    gpu.height = view.height;
    gpu.n_channels = view.channels;
    gpu.pack_offset = view.pack_offset;
    if (view.masked) {
      gpu.rows_before = first_row;
      first_row += view.height + 1;
    }
    std::copy_n(view.scene_from_camera.begin(), 12, gpu.camera.scene_from_camera);
    views.push_back(gpu);
  }
  return views;
}

GpuScene MakeGpuScene(const PixelSource& pixels, const DepthSource& depths) {
  GpuScene scene;
  scene.views = MakeGpuViews(pixels);
  scene.pixels_before = pixels.pixels_before();
  scene.rows_before = pixels.rows_before();
  const ImagePack& pack = pixels.pack();
  scene.pack = pack.data();
  scene.pack_bytes = pack.size_bytes();
  scene.depths = depths.targets();
  return scene;
}

std::vector<torch::Tensor> ValuesOf(const NrffField& field) {
  std::vector<torch::Tensor> values;
  for (const NrffField::Parameter& parameter : field.parameters()) values.push_back(parameter.value.detach());
  return values;
}

device::StepControl MakeControl(const SceneMap& map, const RenderOptions& options) {
  device::StepControl control;
  control.jitter = options.jitter.has_value();
  control.march_step = options.step;
  control.near = options.near;
  control.far = options.far;
  control.map = map;
  control.stop_transmittance = float(std::max(options.stop_transmittance, 0.5 * options.colour_tolerance));
  control.weight_threshold = float(options.weight_threshold);
  control.colour_tolerance = float(options.colour_tolerance);
  control.background = float(options.background);
  return control;
}

std::vector<float> Flatten(const GpuModel& model, const std::vector<torch::Tensor>& tensors) {
  std::vector<float> flat(model.n_parameters);
  for (size_t i = 0; i < tensors.size(); ++i) {
    std::copy_n(tensors[i].const_data_ptr<float>(), model.segments[i].n, flat.data() + model.segments[i].begin);
  }
  return flat;
}

void Unflatten(const GpuModel& model, const std::vector<float>& flat, const std::vector<torch::Tensor>& tensors) {
  for (size_t i = 0; i < tensors.size(); ++i) {
    std::copy_n(flat.data() + model.segments[i].begin, model.segments[i].n, tensors[i].mutable_data_ptr<float>());
  }
}

}  // namespace nrff
