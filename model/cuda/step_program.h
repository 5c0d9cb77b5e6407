// One training step of the NRFF model as a sequence of kernels of device_runtime.h: rays → samples → densities and
// weights → networks → colours and losses → all gradients → Adam. What model/training_step.h does on a CPU, and held
// against it; its shortcuts are the same, but for the samples behind a ray's stop, whose densities are evaluated, too.
//
// Sums of gradients are made by atomic additions: the last bits of a result change from run to run.
#pragma once

#include <algorithm>
#include <functional>
#include <optional>
#include <type_traits>
#include <vector>

#include "model/cuda/gpu_trainer.h"
#include "model/cuda/step_memory.h"
#include "model/kernels/feature_grid_programs.h"
#include "model/kernels/shading_programs.h"
#include "render/kernels/device_runtime.h"
#include "render/kernels/trace_programs.h"

namespace nrff::device {

template <typename Storage>
class StepProgram {
 public:
  using Number = typename Storage::Number;
  using Table = typename Storage::Table;

  // `trains`: or only makes pictures, in less memory.
  StepProgram(const GpuModel& model, const GpuScene& scene, int occupancy_resolution, bool trains, CudaStream stream)
      : model_(model),
        trains_(trains),
        stream_(stream),
        matmul_(stream),
        columns_(ColumnsOf(model)),
        density_(model.density),
        appearance_(model.appearance),
        parameters_(model.n_parameters),
        m_(trains ? model.n_parameters : 0),
        v_(m_.size()),
        gradient_(m_.size()),
        occupancy_resolution_(occupancy_resolution),
        occupancy_cells_(int64_t{occupancy_resolution} * occupancy_resolution * occupancy_resolution / 64),
        occupancy_blocks_(occupancy_cells_.size() / 8),
        control_(1),
        result_(1),
        adam_(1) {
    if constexpr (!std::is_same_v<Table, float>) tables_ = Buffer<Table>(std::max<int64_t>(model.n_grid, 1));
    n_views_ = static_cast<int>(scene.views.size());
    n_depths_ = static_cast<int64_t>(scene.depths.size());
    views_ = Upload(scene.views.data(), n_views_);
    pixels_before_ = Upload(scene.pixels_before.data(), static_cast<int64_t>(scene.pixels_before.size()));
    rows_before_ = Upload(scene.rows_before.data(), static_cast<int64_t>(scene.rows_before.size()));
    pack_ = Upload(scene.pack, static_cast<int64_t>(scene.pack_bytes));
    depths_ = Upload(scene.depths.data(), n_depths_);
    std::vector<Lobe<float>> lobes;
    lobes.reserve(static_cast<size_t>(model.lobes.size()));
    for (int l = 0; l < model.lobes.size(); ++l) {
      lobes.push_back({static_cast<float>(model.lobes.sin_theta[l]), static_cast<float>(model.lobes.cos_theta[l]),
                       static_cast<float>(model.lobes.sin_phi[l]), static_cast<float>(model.lobes.cos_phi[l])});
    }
    lobes_ = Upload(lobes.data(), static_cast<int64_t>(lobes.size()));
    std::vector<int64_t> begins;
    for (const GridLayout::Level& level : model.density.levels) {
      begins.insert(begins.end(), level.plane_offsets.begin(), level.plane_offsets.end());
      begins.insert(begins.end(), level.line_offsets.begin(), level.line_offsets.end());
    }
    begins.push_back(model.density.n_parameters);
    density_factors_ = Upload(begins.data(), static_cast<int64_t>(begins.size()));
    for (const auto& layer : model.spatial) layers_.emplace_back(layer);
    if (model.encoding == DirectionalEncoding::kRee) layers_.emplace_back(model.lobe_layer);
    for (const auto& layer : model.directional) layers_.emplace_back(layer);
  }

  // Bytes of a step's memory, and of what does not depend on a step's room, but for some MiB.
  static size_t BytesOf(const GpuModel& model, const GpuRoom& room, bool trains) {
    Arena arena(nullptr);
    const StepMemory<Storage> memory(model, ColumnsOf(model), room, trains, arena);
    return arena.used();
  }
  static size_t BytesOf(const GpuModel& model, bool trains) {
    const auto n = static_cast<size_t>(model.n_parameters), n_grid = static_cast<size_t>(model.n_grid);
    return n * sizeof(float) * (trains ? 5 : 1) + (std::is_same_v<Table, float> ? 0 : n_grid * sizeof(Table)) +
           (n - n_grid) * (sizeof(Number) + sizeof(float));  // of layers
  }
  size_t BytesOf(const GpuRoom& room) const { return BytesOf(model_, room, trains_); }
  // Throws OutOfDeviceMemory; then there is no room at all.
  void MakeRoom(const GpuRoom& room) {
    memory_.reset();
    block_ = {};
    block_ = Buffer<char>(static_cast<int64_t>(BytesOf(room)));
    Arena arena(block_.data());
    memory_.emplace(model_, columns_, room, trains_, arena);
    room_ = room;
  }
  const GpuRoom& room() const { return room_; }
  bool has_room() const { return memory_.has_value(); }

  StepControl* control() const { return control_.data(); }
  StepResult* result() const { return result_.data(); }
  float* parameters() const { return parameters_.data(); }
  float* m() const { return m_.data(); }
  float* v() const { return v_.data(); }
  float* gradient() const { return gradient_.data(); }
  AdamState* adam() const { return adam_.data(); }

  void SetOccupancy(const OccupancyBits& bits) {
    if (bits.resolution != occupancy_resolution_) throw std::invalid_argument("occupancy grid: another resolution");
    CopyToDevice(occupancy_cells_.data(), bits.cells, occupancy_cells_.size() * sizeof(uint64_t), stream_);
    CopyToDevice(occupancy_blocks_.data(), bits.blocks, occupancy_blocks_.size(), stream_);
  }

  void SetViews(const std::vector<GpuView>& views) {
    if (static_cast<int>(views.size()) != n_views_) throw std::invalid_argument("views: another number of them");
    CopyToDevice(views_.data(), views.data(), views.size() * sizeof(GpuView), stream_);
  }

  // After the parameters were set: what is made of them.
  void QueueTables() {
    if constexpr (!std::is_same_v<Table, float>) {
      ForEach("tables", model_.n_grid, stream_, Convert<Table>{parameters_.data(), tables_.data()});
    }
  }

  // As the control on the device says.
  void QueueStep() {
    ForEach("begin", 1, stream_, BeginStep{result_.data()});
    Zero(gradient_.data(), static_cast<size_t>(gradient_.size()) * sizeof(float), stream_);
    QueueRays();
    QueueCount();
    QueueTrace();
    QueueSelectCount();
    QueueSelect();
    QueuePackWeights();
    QueueShade(room_.shaded);
    QueueLosses();
    QueueShadeBackward();
    QueueDensityBackward();
    QueueOptimise();
  }

  // Pictures in three parts, between which the host sees how many samples there are.
  void QueuePictureRays(const GpuRays& rays, int64_t first, int64_t n) {
    ForEach("begin", 1, stream_, BeginStep{result_.data()});
    if (rays.origins != nullptr) {
      const size_t n_bytes = static_cast<size_t>(3 * n) * sizeof(float);
      CopyToDevice(memory_->origins, rays.origins + 3 * first, n_bytes, stream_);
      CopyToDevice(memory_->directions, rays.directions + 3 * first, n_bytes, stream_);
    } else {
      ForEach("view", n, stream_,
              DrawView{control_.data(), rays.camera, rays.width, rays.first + first, memory_->origins,
                       memory_->directions});
    }
    QueueCount();
  }
  void QueuePictureWeights() {
    QueueTrace();
    QueueSelectCount();
  }
  // rows: of the networks, for all samples to be shaded; a multiple of 8.
  void QueuePictureColours(int64_t rows, int64_t first, int64_t n, const GpuPicture& picture) {
    StepMemory<Storage>& at = *memory_;
    if (rows > 0) {
      QueueSelect();
      QueueShade(rows);
    }
    ForEach("picture", n, stream_,
            PictureRays{control_.data(), at.ray_offsets, at.shaded_offsets, at.shaded, at.t, at.weights,
                        at.transmittance, at.rgb, at.reflections, at.colour, at.depth, at.normal, at.opacity});
    const auto copy = [&](float* to, const float* from, int64_t n_channels) {
      CopyToHost(to + n_channels * first, from, static_cast<size_t>(n_channels * n) * sizeof(float), stream_);
    };
    copy(picture.rgb, at.colour, 3);
    copy(picture.depth, at.depth, 1);
    copy(picture.normal, at.normal, 3);
    copy(picture.opacity, at.opacity, 1);
  }
  // Of the present parameters, for pictures.
  void QueuePackWeights() {
    for (Layer& layer : layers_) {
      ForEach("pack weights", layer.packed.size(), stream_,
              PackWeight<Number>{parameters_.data() + layer.shape.weight, layer.shape.n_out, layer.shape.n_in,
                                 layer.in_row, layer.packed.data()});
    }
  }

  // points and sigma on the device.
  void QueueDensities(const float* points, const int64_t* n, int64_t room, float* sigma) {
    WithDensityChannels([&](auto channels) {
      constexpr int kChannels = decltype(channels)::value;
      const DensityForwardProgram<Table, kChannels> program{
          density_, Tables(), points, n, room, model_.density_scale, model_.density_shift, sigma};
      ForEach("densities", program.size(), stream_, program);
    });
  }

 private:
  struct Layer {
    explicit Layer(const GpuModel::Layer& layer)
        : shape(layer),
          in_row(Padded(layer.n_in)),
          out_row(Padded(layer.n_out)),
          packed(in_row * out_row),
          gradient(in_row * out_row) {}
    GpuModel::Layer shape;
    int64_t in_row, out_row;
    Buffer<Number> packed;   // [out_row][in_row]
    Buffer<float> gradient;  // the same
  };

  static ShadingColumns ColumnsOf(const GpuModel& model) {
    ShadingColumns columns{};
    columns.spatial_out_row = Padded(model.spatial.back().n_out);
    if (model.encoding == DirectionalEncoding::kNone) return columns;
    columns.bottleneck_width = model.bottleneck_width;
    columns.lobe_row_width = model.lobe_layer.n_in;
    columns.n_theta = model.lobes.n_theta;
    columns.n_phi = model.lobes.n_phi;
    columns.directional_in_row = Padded(model.directional.front().n_in);
    columns.lobe_in_row = Padded(model.lobe_layer.n_in);
    columns.lobe_raw_row = Padded(model.lobe_layer.n_out);
    columns.specular_row = Padded(model.directional.back().n_out);
    return columns;
  }

  template <typename T>
  Buffer<T> Upload(const T* from, int64_t n) {
    Buffer<T> buffer(std::max<int64_t>(n, 1));
    if (n > 0) CopyToDevice(buffer.data(), from, static_cast<size_t>(n) * sizeof(T), stream_);
    return buffer;
  }

  const Table* Tables() const {
    if constexpr (std::is_same_v<Table, float>) {
      return parameters_.data();
    } else {
      return tables_.data();
    }
  }
  const Table* AppearanceTable() const { return Tables() + model_.segments[1].begin; }

  template <typename Work>
  void WithDensityChannels(const Work& work) const {
    WithChannels(density_.n_channels, work);
  }
  template <typename Work>
  static void WithChannels(int n_channels, const Work& work) {
    if (n_channels == 2) {
      work(std::integral_constant<int, 2>{});
    } else {
      work(std::integral_constant<int, 4>{});
    }
  }

  bool directional() const { return model_.encoding == DirectionalEncoding::kRee; }
  size_t n_spatial() const { return model_.spatial.size(); }
  Layer& lobe_layer() { return layers_[n_spatial()]; }
  Layer* directional_layers() { return &layers_[n_spatial() + 1]; }
  OccupancyBits occupancy() const { return {occupancy_resolution_, occupancy_cells_.data(), occupancy_blocks_.data()}; }
  const int64_t* n_samples() const { return memory_->ray_offsets + room_.rays; }  // on the device
  const int64_t* n_shaded() const { return memory_->shaded_offsets + room_.rays; }

  void QueueRays() {
    StepMemory<Storage>& at = *memory_;
    ForEach("pixels", room_.rays, stream_,
            DrawPixels{control_.data(), views_.data(), pixels_before_.data(), rows_before_.data(), n_views_,
                       pack_.data(), at.origins, at.directions, at.target, at.view_of_ray});
    if (n_depths_ > 0) {
      ForEach("depths", room_.rays, stream_,
              DrawDepths{control_.data(), depths_.data(), static_cast<uint64_t>(n_depths_), at.origins, at.directions,
                         at.distance, at.spread});
    }
  }

  // counts → offsets, kept within `most`.
  void QueueOffsets(int64_t* offsets, int64_t most, int64_t* total) {
    StepMemory<Storage>& at = *memory_;
    ExclusiveSums(at.counts, room_.rays, offsets, at.scratch, at.scratch_bytes, stream_);
    ForEach("offsets", room_.rays + 1, stream_, LimitOffsets{room_.rays, most, offsets, total});
  }

  void QueueCount() {
    StepMemory<Storage>& at = *memory_;
    ForEach("count samples", room_.rays, stream_,
            CountSamples{control_.data(), occupancy(), at.origins, at.directions, at.counts});
    QueueOffsets(at.ray_offsets, room_.samples, &result_.data()->n_samples);
  }

  void QueueTrace() {
    StepMemory<Storage>& at = *memory_;
    ForEach("fill samples", room_.rays, stream_,
            FillSamples{control_.data(), occupancy(), at.origins, at.directions, at.ray_offsets, at.t, at.delta,
                        at.points});
    QueueDensities(at.points, n_samples(), room_.samples, at.sigma);
    WeightsArgs<float> args;
    args.ray_offsets = at.ray_offsets;
    args.sigma = at.sigma;
    args.delta = at.delta;
    args.weights = at.weights;
    args.transmittance = at.transmittance;
    args.n_reached = at.n_reached;
    ForEach("weights", room_.rays, stream_, ComputeWeights{control_.data(), args});
  }

  void QueueSelectCount() {
    StepMemory<Storage>& at = *memory_;
    ForEach("count shaded", room_.rays, stream_, CountShaded{control_.data(), at.ray_offsets, at.weights, at.counts});
    QueueOffsets(at.shaded_offsets, room_.shaded, &result_.data()->n_shaded);
  }

  void QueueSelect() {
    StepMemory<Storage>& at = *memory_;
    ForEach("fill shaded", room_.rays, stream_,
            FillShaded{control_.data(), at.ray_offsets, at.shaded_offsets, at.weights, at.points, at.directions,
                       at.shaded, at.shaded_points, at.shaded_directions});
  }

  // input [rows][in_row] → values [rows][out_row], in one of the two forms; without the bias.
  void QueueProducts(const Layer& layer, const Number* input, int64_t rows, Number* values, float* values_float) {
    MatmulArgs<Number> args;
    args.m = rows;
    args.n = layer.out_row;
    args.k = layer.in_row;
    args.a = input;
    args.a_row = layer.in_row;
    args.b = layer.packed.data();
    args.b_row = layer.in_row;
    args.b_transposed = true;
    args.c = values;
    args.c_float = values_float;
    args.c_row = layer.out_row;
    matmul_(args);
  }
  void QueueLastLayer(const Layer& layer, const Number* input, int64_t rows, float* values) {
    QueueProducts(layer, input, rows, nullptr, values);
    ForEach("bias", rows * layer.out_row, stream_,
            AddBias{parameters_.data() + layer.shape.bias, layer.shape.n_out, layer.out_row, values});
  }

  // The layers before `first_activated` are followed by no activation.
  void QueueNetwork(const Layer* layers, size_t n_layers, size_t first_activated, int64_t rows, const Number* input,
                    const std::vector<typename StepMemory<Storage>::Hidden>& hidden, float* output) {
    for (size_t l = 0; l + 1 < n_layers; ++l) {
      const Layer& layer = layers[l];
      QueueProducts(layer, l == 0 ? input : hidden[l - 1].values, rows, hidden[l].values, nullptr);
      ForEach("activation", rows * layer.out_row, stream_,
              Activate<Number>{parameters_.data() + layer.shape.bias, layer.shape.n_out, layer.out_row,
                               model_.activation, l >= first_activated, hidden[l].values, hidden[l].derivative});
    }
    QueueLastLayer(layers[n_layers - 1], n_layers == 1 ? input : hidden.back().values, rows, output);
  }

  // Gradients of the layer's weight and bias and, unless it is null, of its input. d_output [rows][out_row].
  void QueueLayerBackward(Layer& layer, const Number* input, const Number* d_output, int64_t rows, Number* d_input) {
    MatmulArgs<Number> of_weight;  // d_outputᵀ input
    of_weight.m = layer.out_row;
    of_weight.n = layer.in_row;
    of_weight.k = rows;
    of_weight.a = d_output;
    of_weight.a_row = layer.out_row;
    of_weight.a_transposed = true;
    of_weight.b = input;
    of_weight.b_row = layer.in_row;
    of_weight.c_float = layer.gradient.data();
    of_weight.c_row = layer.in_row;
    matmul_(of_weight);
    ForEach(
        "unpack gradient", int64_t{layer.shape.n_out} * layer.shape.n_in, stream_,
        UnpackGradient{layer.gradient.data(), layer.shape.n_in, layer.in_row, gradient_.data() + layer.shape.weight});
    const SumColumns<Number> of_bias{d_output, rows, layer.shape.n_out, layer.out_row,
                                     gradient_.data() + layer.shape.bias};
    ForEach("sum columns", of_bias.size(), stream_, of_bias);
    if (d_input == nullptr) return;
    MatmulArgs<Number> of_input;  // d_output weight
    of_input.m = rows;
    of_input.n = layer.in_row;
    of_input.k = layer.out_row;
    of_input.a = d_output;
    of_input.a_row = layer.out_row;
    of_input.b = layer.packed.data();
    of_input.b_row = layer.in_row;
    of_input.c = d_input;
    of_input.c_row = layer.in_row;
    matmul_(of_input);
  }

  // d_output → d_input, [room][row] each; d_input is none of layer_gradients.
  void QueueNetworkBackward(Layer* layers, size_t n_layers, const Number* input,
                            const std::vector<typename StepMemory<Storage>::Hidden>& hidden, const Number* d_output,
                            Number* d_input) {
    for (size_t l = n_layers; l-- > 0;) {
      Number* d_before = l == 0 ? d_input : memory_->layer_gradients[l % 2];
      QueueLayerBackward(layers[l], l == 0 ? input : hidden[l - 1].values, d_output, room_.shaded, d_before);
      if (l > 0) {
        ForEach("activation backward", room_.shaded * layers[l].in_row, stream_,
                MultiplyBy<Number>{hidden[l - 1].derivative, d_before});
      }
      d_output = d_before;
    }
  }

  void QueueShade(int64_t rows) {
    StepMemory<Storage>& at = *memory_;
    WithChannels(appearance_.n_channels, [&](auto channels) {
      constexpr int kChannels = decltype(channels)::value;
      const GridConcatForwardProgram<Table, Number, kChannels> program{
          appearance_, AppearanceTable(), at.shaded_points, n_shaded(), rows, at.features, layers_[0].in_row};
      ForEach("appearance features", program.size(), stream_, program);
    });
    QueueNetwork(layers_.data(), n_spatial(), model_.decodes ? 1 : 0, rows, at.features, at.spatial_hidden,
                 at.spatial_out);
    if (directional()) {
      ForEach("reflect", rows, stream_,
              ReflectSamples<Number>{columns_, n_shaded(), at.spatial_out, at.shaded_directions, at.reflections,
                                     at.directional_in});
      ForEach("share", rows * columns_.spatial_out_row, stream_,
              ShareSpatial<Number>{columns_, at.spatial_out, at.directional_in, at.lobe_in});
      QueueLastLayer(lobe_layer(), at.lobe_in, rows * columns_.n_theta, at.lobe_raw);
      ForEach("lobes", rows * columns_.n_lobes(), stream_,
              EncodeLobes<Number>{columns_, lobes_.data(), at.reflections, at.lobe_raw, at.directional_in});
      QueueNetwork(directional_layers(), model_.directional.size(), 0, rows, at.directional_in, at.directional_hidden,
                   at.specular);
    }
    ForEach("colours", rows, stream_,
            ColourSamples{at.spatial_out, at.specular, columns_.spatial_out_row, columns_.specular_row, at.rgb});
  }

  void QueueLosses() {
    StepMemory<Storage>& at = *memory_;
    const auto zero = [&](float* values, int64_t n) { Zero(values, static_cast<size_t>(n) * sizeof(float), stream_); };
    zero(at.d_weights, room_.samples);
    zero(at.d_rgb, 3 * room_.shaded);
    zero(at.d_normals, 3 * room_.shaded);
    const float* corrections = model_.corrected_views > 0 ? parameters_.data() + model_.corrections : nullptr;
    ForEach("composite", room_.rays, stream_,
            CompositeRays{control_.data(), at.shaded_offsets, at.shaded, at.weights, at.transmittance, at.target,
                          at.rgb, at.shaded_directions, at.reflections, at.view_of_ray, corrections, at.d_weights,
                          at.d_transmittance, at.d_rgb, at.d_normals, gradient_.data() + model_.corrections,
                          result_.data()});
    if (n_depths_ > 0) {
      ForEach("match depths", room_.rays, stream_,
              MatchDepths{control_.data(), at.ray_offsets, at.t, at.weights, at.distance, at.spread, at.d_weights,
                          at.d_transmittance, result_.data()});
    }
  }

  void QueueShadeBackward() {
    StepMemory<Storage>& at = *memory_;
    ForEach("colours backward", room_.shaded, stream_,
            ColourBackward<Number>{at.spatial_out, at.specular, at.rgb, at.d_rgb, columns_.spatial_out_row,
                                   columns_.specular_row, at.d_spatial_out, at.d_specular});
    if (directional()) {
      QueueNetworkBackward(directional_layers(), model_.directional.size(), at.directional_in, at.directional_hidden,
                           at.d_specular, at.d_directional_in);
      Zero(at.d_reflected, static_cast<size_t>(3 * room_.shaded) * sizeof(float), stream_);
      ForEach("lobes backward", room_.shaded * columns_.n_theta, stream_,
              EncodeLobesBackward<Number>{columns_, lobes_.data(), at.reflections, at.lobe_raw, at.d_directional_in,
                                          at.d_lobe_raw, at.d_reflected});
      QueueLayerBackward(lobe_layer(), at.lobe_in, at.d_lobe_raw, room_.shaded * columns_.n_theta, at.d_lobe_in);
      ForEach("gather", room_.shaded * columns_.spatial_out_row, stream_,
              GatherSpatialGradient<Number>{columns_, at.reflections, n_shaded(), at.shaded_directions, at.d_reflected,
                                            at.d_normals, at.d_directional_in, at.d_lobe_in, at.d_spatial_out});
    }
    QueueNetworkBackward(layers_.data(), n_spatial(), at.features, at.spatial_hidden, at.d_spatial_out, at.d_features);
    WithChannels(appearance_.n_channels, [&](auto channels) {
      constexpr int kChannels = decltype(channels)::value;
      const GridConcatBackwardProgram<Table, Number, kChannels> program{
          appearance_,  AppearanceTable(), at.shaded_points,  n_shaded(),
          room_.shaded, at.d_features,     layers_[0].in_row, gradient_.data() + model_.segments[1].begin};
      ForEach("appearance backward", program.size(), stream_, program);
    });
  }

  void QueueDensityBackward() {
    StepMemory<Storage>& at = *memory_;
    WeightsBackwardArgs<float> args;
    args.ray_offsets = at.ray_offsets;
    args.delta = at.delta;
    args.weights = at.weights;
    args.transmittance = at.transmittance;
    args.n_reached = at.n_reached;
    args.dL_dweights = at.d_weights;
    args.dL_dtransmittance = at.d_transmittance;
    args.dL_dsigma = at.d_sigma;
    ForEach("weights backward", room_.rays, stream_, WeightsBackward{control_.data(), args});
    ForEach("sparsity", room_.rays, stream_,
            AddSparsity{control_.data(), at.ray_offsets, at.n_reached, at.sigma, at.delta, at.d_sigma, result_.data()});
    WithDensityChannels([&](auto channels) {
      constexpr int kChannels = decltype(channels)::value;
      const DensityBackwardProgram<Table, kChannels> program{density_,    Tables(),      at.points,
                                                             n_samples(), room_.samples, model_.density_scale,
                                                             at.sigma,    at.d_sigma,    gradient_.data()};
      ForEach("density backward", program.size(), stream_, program);
    });
  }

  void QueueOptimise() {
    ForEach("find not finite", gradient_.size(), stream_, FindNotFinite{gradient_.data(), result_.data()});
    ForEach("decide", 1, stream_,
            DecideStep{control_.data(), room_.samples, room_.shaded, adam_.data(), result_.data()});
    DensityL1 l1;
    l1.n_factors = static_cast<int>(density_factors_.size()) - 1;
    l1.begins = density_factors_.data();
    ForEach("Adam", parameters_.size(), stream_,
            AdamProgram<Table>{control_.data(), result_.data(), adam_.data(), model_.n_grid, model_.corrections,
                               model_.corrected_views, l1, gradient_.data(), parameters_.data(), m_.data(), v_.data(),
                               tables_.data()});
  }

  GpuModel model_;
  bool trains_;
  CudaStream stream_;
  Matmul matmul_;
  ShadingColumns columns_;
  GridLevels density_, appearance_;
  Buffer<float> parameters_, m_, v_, gradient_;
  Buffer<Table> tables_;  // of the grids' parameters; empty with tables of float
  std::vector<Layer> layers_;
  int occupancy_resolution_;
  Buffer<uint64_t> occupancy_cells_;
  Buffer<uint8_t> occupancy_blocks_;
  Buffer<StepControl> control_;
  Buffer<StepResult> result_;
  Buffer<AdamState> adam_;
  int n_views_ = 0;
  int64_t n_depths_ = 0;
  Buffer<GpuView> views_;
  Buffer<uint64_t> pixels_before_;
  Buffer<uint32_t> rows_before_;
  Buffer<uint8_t> pack_;
  Buffer<DepthTarget> depths_;
  Buffer<Lobe<float>> lobes_;
  Buffer<int64_t> density_factors_;
  Buffer<char> block_;
  std::optional<StepMemory<Storage>> memory_;
  GpuRoom room_;
};

}  // namespace nrff::device
