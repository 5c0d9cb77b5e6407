#include "model/nrff_field.h"

#include <ATen/ATen.h>
#include <c10/core/GradMode.h>

#include <algorithm>
#include <cmath>
#include <numbers>

#include "model/directional_encoding.h"
#include "model/grid_crop.h"
#include "model/kernels/tile_rows.h"
#include "render/kernels/colour_correction.h"
#include "render/kernels/random.h"

namespace nrff {
namespace {

using torch::Tensor;

constexpr double kGridStd = 0.1;
constexpr int kSpatialColours = 9;  // diffuse, tint, normal

// What the spatial network makes for the encoding.
int EncodingShare(const FieldConfig& config) {
  switch (config.directional_encoding) {
    case DirectionalEncoding::kRee:
      return config.lobes_theta * config.lobe_row_width;
    case DirectionalEncoding::kIde:
      return 1;
    default:
      return 0;
  }
}

int EncodingFeatures(const FieldConfig& config) {
  switch (config.directional_encoding) {
    case DirectionalEncoding::kRee:
      return config.lobes_theta * config.lobes_phi * kLobeAmplitudes;
    case DirectionalEncoding::kIde:
      return kIdeFeatures;
    case DirectionalEncoding::kPe:
      return kPeFeatures;
    default:
      return 0;
  }
}

// Draw number `counter` of a standard normal, by Box and Muller.
double Normal(uint64_t seed, uint64_t stream, uint64_t counter) {
  const double u = 1 - double(Uniform(seed, stream, 2 * counter));  // (0, 1]
  const double v = double(Uniform(seed, stream, 2 * counter + 1));
  return std::sqrt(-2 * std::log(u)) * std::cos(2 * std::numbers::pi * v);
}

// Fills a contiguous tensor with draw(index).
template <typename Draw>
void Fill(const Tensor& tensor, const Draw& draw) {
  const int64_t n = tensor.numel();
  if (tensor.scalar_type() == torch::kFloat) {
    auto* data = tensor.mutable_data_ptr<float>();
    for (int64_t i = 0; i < n; ++i) data[i] = float(draw(i));
  } else {
    auto* data = tensor.mutable_data_ptr<double>();
    for (int64_t i = 0; i < n; ++i) data[i] = float(draw(i));  // the same numbers in either type
  }
}

// Calls body(offset, n_elements) for every plane and line.
template <typename Body>
void ForEachFactor(const GridLayout& layout, const Body& body) {
  for (const GridLayout::Level& level : layout.levels) {
    const int64_t n_line = int64_t(level.resolution) * layout.n_channels;
    for (const int64_t offset : level.plane_offsets) body(offset, n_line * level.resolution);
    for (const int64_t offset : level.line_offsets) body(offset, n_line);
  }
}

}  // namespace

NrffField::NrffField(const FieldConfig& config, torch::Dtype type, uint64_t seed)
    : config_(config),
      type_(type),
      density_layout_(c10::make_intrusive<SharedGridLayout>(
          MakeGridLayout(config.levels, config.base_resolution, config.max_resolution, config.density_channels,
                         config.finest_left_out))),
      appearance_layout_(c10::make_intrusive<SharedGridLayout>(
          MakeGridLayout(config.levels, config.base_resolution, config.max_resolution, config.appearance_channels,
                         config.finest_left_out))),
      lobes_(c10::make_intrusive<SharedLobes>(MakeLobes(config.lobes_theta, config.lobes_phi))) {
  density_grid_ = AddParameter("density_grid", {density_layout().n_parameters}, true);
  appearance_grid_ = AddParameter("appearance_grid", {appearance_layout().n_parameters}, true);
  const bool directional = config.directional_encoding != DirectionalEncoding::kNone;
  int n_features = appearance_layout().n_features();
  if (config.decoded_features > 0) {
    spatial_.push_back(MakeLinear("decoder", n_features, config.decoded_features));
    n_features = config.decoded_features;
  }
  const int n_spatial = directional ? kSpatialColours + config.bottleneck_width + EncodingShare(config) : 3;
  for (Linear& layer : MakeMlp("spatial_mlp", n_features, config.spatial_width, config.spatial_layers, n_spatial)) {
    spatial_.push_back(std::move(layer));
  }
  if (config.directional_encoding == DirectionalEncoding::kRee) {
    lobe_layer_ = MakeLinear("lobes", config.lobe_row_width, config.lobes_phi * kLobeParameters);
  }
  if (directional) {
    directional_ = MakeMlp("directional_mlp", config.bottleneck_width + EncodingFeatures(config) + 1,
                           config.directional_width, config.directional_layers, 3);
  }
  if (config.corrected_views > 0) {
    colour_corrections_ = AddParameter("colour_corrections", {config.corrected_views, kCorrectionParameters}, false);
  }
  density_l1_weights_ = at::empty({density_layout().n_parameters}, type);
  const double n_factors = 2. * density_layout().n_products();
  ForEachFactor(density_layout(), [&](int64_t offset, int64_t n) {
    density_l1_weights_.narrow(0, offset, n).fill_(1 / (double(n) * n_factors));
  });
  Initialise(seed);
}

Tensor NrffField::AddParameter(const std::string& name, const std::vector<int64_t>& shape, bool is_grid) {
  Tensor value = at::zeros(shape, type_);
  value.requires_grad_(true);
  parameters_.push_back({name, value, is_grid});
  return value;
}

NrffField::Linear NrffField::MakeLinear(const std::string& name, int n_in, int n_out) {
  return {AddParameter(name + ".weight", {n_out, n_in}, false), AddParameter(name + ".bias", {n_out}, false)};
}

NrffField::Mlp NrffField::MakeMlp(const std::string& name, int n_in, int width, int n_layers, int n_out) {
  Mlp mlp;
  for (int i = 0; i < n_layers; ++i) {
    const bool last = i == n_layers - 1;
    mlp.push_back(MakeLinear(name + "." + std::to_string(i), i == 0 ? n_in : width, last ? n_out : width));
  }
  return mlp;
}

// Grids: normal; linear layers: uniform in ±1/√n_in, weights and biases, as torch.nn.Linear.
void NrffField::Initialise(uint64_t seed) {
  const c10::NoGradGuard no_grad;
  double bound = 0;
  for (size_t p = 0; p < parameters_.size(); ++p) {
    const Tensor& value = parameters_[p].value;
    const uint64_t stream = StreamAt(RandomStream::kInitialisation, p);
    if (parameters_[p].is_grid) {
      Fill(value, [&](int64_t i) { return kGridStd * Normal(seed, stream, i); });
    } else if (!value.is_same(colour_corrections_)) {                      // which start at none
      if (value.dim() == 2) bound = 1 / std::sqrt(double(value.size(1)));  // a bias follows its weight
      Fill(value, [&](int64_t i) { return bound * (2 * double(Uniform(seed, stream, i)) - 1); });
    }
  }
  const GridLayout& layout = appearance_layout();
  for (const GridLayout::Level& level : layout.levels) {
    for (const int64_t offset : level.line_offsets) {
      appearance_grid_.narrow(0, offset, int64_t(level.resolution) * layout.n_channels)
          .add_(config_.appearance_line_mean);
    }
  }
}

Tensor NrffField::Linear::operator()(const Tensor& x) const { return at::linear(x, weight, bias); }

Tensor NrffField::Apply(const Mlp& mlp, Tensor x, size_t first_activated) const {
  for (size_t i = 0; i < mlp.size(); ++i) {
    x = mlp[i](x);
    if (i + 1 == mlp.size()) break;
    if (i < first_activated) continue;
    x = config_.activation == Activation::kGelu ? at::gelu(x) : at::relu(x);
  }
  return x;
}

Tensor NrffField::DensityFeature(const Tensor& points) const {
  return GridSum(density_layout_, density_grid_, points.to(type_));
}

Tensor NrffField::DensityFromFeature(const Tensor& feature) const {
  return at::softplus(feature + config_.density_shift) * config_.density_scale;
}

Tensor NrffField::Density(const Tensor& points) const { return DensityFromFeature(DensityFeature(points)); }

Tensor NrffField::AppearanceFeature(const Tensor& points) const {
  return GridConcat(appearance_layout_, appearance_grid_, points.to(type_));
}

NrffField::ShadingParts NrffField::ShadeFeature(const Tensor& appearance_feature, const Tensor& ray_directions) const {
  const int64_t n = appearance_feature.size(0);
  const Tensor spatial_out = Apply(spatial_, appearance_feature, config_.decoded_features > 0 ? 1 : 0);
  ShadingParts parts;
  if (config_.directional_encoding == DirectionalEncoding::kNone) {
    parts.diffuse = spatial_out;
    parts.normal = at::zeros_like(spatial_out);
    parts.rgb = at::sigmoid(parts.diffuse);
    return parts;
  }
  const std::vector<Tensor> spatial =
      at::split_with_sizes(spatial_out, {3, 3, 3, config_.bottleneck_width, EncodingShare(config_)}, 1);
  parts.diffuse = spatial[0];
  parts.tint = spatial[1];
  parts.normal = spatial[2] / -spatial[2].norm(2, {1}, /*keepdim=*/true).clamp_min(1e-12);
  parts.bottleneck = spatial[3];
  parts.encoding_share = spatial[4];

  const Tensor wo = -ray_directions.to(type_);
  const Tensor cosine = (wo * parts.normal).sum(1, /*keepdim=*/true);
  parts.reflected_direction = 2 * cosine * parts.normal - wo;
  if (config_.directional_encoding == DirectionalEncoding::kIde) {
    parts.encoding = IdeEncode(parts.reflected_direction, parts.encoding_share);
  } else if (config_.directional_encoding == DirectionalEncoding::kPe) {
    parts.encoding = PeEncode(-wo);
  } else {
    parts.lobe_parameters =
        lobe_layer_(parts.encoding_share.reshape({n * config_.lobes_theta, config_.lobe_row_width})).view({n, -1});
    parts.encoding = ReeEncode(lobes_, parts.reflected_direction, parts.lobe_parameters);
  }
  const Tensor specular = Apply(directional_, at::cat({parts.bottleneck, parts.encoding, cosine}, 1));
  parts.rgb = at::sigmoid(parts.diffuse + parts.tint * specular);
  return parts;
}

RadianceField::Shading NrffField::Shade(const Tensor& points, const Tensor& ray_directions) const {
  const ShadingParts parts = ShadeFeature(AppearanceFeature(points), ray_directions);
  return {parts.rgb, parts.normal};
}

void NrffField::DensityOf(const float* points, int64_t n, float* sigma) const {
  GridSumForward(density_layout(), density_parameters(), points, n, sigma);
  DensitiesFromFeatures(float(config_.density_scale), float(config_.density_shift), n, sigma);
}

ShadingNetworks NrffField::Networks() const {
  const auto view = [](const Linear& linear) {
    return LinearLayer{.n_in = int(linear.weight.size(1)),
                       .n_out = int(linear.weight.size(0)),
                       .weight = linear.weight.const_data_ptr<float>(),
                       .bias = linear.bias.const_data_ptr<float>()};
  };
  ShadingNetworks networks;
  networks.decodes = config_.decoded_features > 0;
  for (const Linear& linear : spatial_) networks.spatial.push_back(view(linear));
  for (const Linear& linear : directional_) networks.directional.push_back(view(linear));
  networks.encoding = config_.directional_encoding;
  if (networks.encoding == DirectionalEncoding::kRee) {
    networks.lobe_layer = view(lobe_layer_);
    networks.lobes = lobes_->lobes;
  }
  networks.bottleneck_width = config_.bottleneck_width;
  networks.activation = config_.activation;
  return networks;
}

namespace {

class TileShader : public RadianceField::Shader {
 public:
  TileShader(const NrffField& field, GemmPrecision precision)
      : field_(field), networks_(field.Networks()), tile_(networks_, /*backward=*/false, precision) {
    tile_.Reserve(kMostAtOnce);
    packed_.Pack(networks_, /*backward=*/false, precision);
  }

  void SetSamples(const float* points, const float* weights, int64_t n) override {
    const GridLayout& layout = field_.appearance_layout();
    n_samples_ = n;
    weights_.assign(weights, weights + n);
    features_.resize(n * layout.n_features());
    GridConcatForward(layout, field_.appearance_parameters(), points, n, features_.data());
  }

  // The grid's features are what a span's samples have in common.
  void Shade(const Span* spans, const float* ray_directions, int64_t n, float* rgb, float* normals) override {
    const GridLayout& layout = field_.appearance_layout();
    for (int64_t begin = 0; begin < n; begin += kMostAtOnce) {
      const int64_t n_tile = std::min(kMostAtOnce, n - begin);
      begins_.resize(n_tile);
      ends_.resize(n_tile);
      for (int64_t s = 0; s < n_tile; ++s) {
        begins_[s] = spans[begin + s].begin;
        ends_[s] = spans[begin + s].end;
      }
      MeansToRows({.n_samples = n_samples_,
                   .features = features_.data(),
                   .weights = weights_.data(),
                   .n_spans = n_tile,
                   .begins = begins_.data(),
                   .ends = ends_.data()},
                  layout, tile_.stride(), tile_.features());
      PointsToRows(ray_directions + 3 * begin, n_tile, tile_.stride(), tile_.ray_directions());
      tile_.Forward(networks_, n_tile);
      RowsToPoints(tile_.rgb(), n_tile, tile_.stride(), rgb + 3 * begin);
      RowsToPoints(tile_.normals(), n_tile, tile_.stride(), normals + 3 * begin);
    }
  }

 private:
  static constexpr int64_t kMostAtOnce = 256;
  const NrffField& field_;
  ShadingNetworks networks_;
  PackedNetworks packed_;
  ShadingTile tile_;
  int64_t n_samples_ = 0;
  std::vector<float> features_, weights_;  // [n_products][n_samples][C], [n_samples]
  std::vector<int64_t> begins_, ends_;
};

}  // namespace

std::unique_ptr<RadianceField::Shader> NrffField::MakeShader(ShadingPrecision precision) const {
  return std::make_unique<TileShader>(
      *this, precision == ShadingPrecision::kBf16 ? GemmPrecision::kBf16 : GemmPrecision::kFloat);
}

// Levels are laid out one after the other, and their features and the columns of the layer that sees them, too.
std::unique_ptr<RadianceField> NrffField::WithoutFinestLevels(int n) const {
  FieldConfig config = config_;
  config.finest_left_out += n;
  if (config.finest_left_out >= config.levels) return nullptr;
  auto coarser = std::make_unique<NrffField>(config, type_, /*seed=*/0);
  const c10::NoGradGuard no_grad;
  for (size_t i = 0; i < parameters_.size(); ++i) {
    Tensor from = parameters_[i].value;
    const Tensor& to = coarser->parameters_[i].value;
    for (int64_t d = 0; d < to.dim(); ++d) from = from.narrow(d, 0, to.size(d));
    to.copy_(from);
  }
  return coarser;
}

Tensor NrffField::DensityL1() const { return at::dot(density_grid_.abs(), density_l1_weights_); }

int64_t NrffField::n_parameters() const {
  int64_t n = 0;
  for (const Parameter& parameter : parameters_) n += parameter.value.numel();
  return n;
}

void NrffField::Crop(const std::array<double, 3>& min, const std::array<double, 3>& max) {
  const c10::NoGradGuard no_grad;
  density_grid_.copy_(CropGrid(density_layout(), density_grid_, min, max));
  appearance_grid_.copy_(CropGrid(appearance_layout(), appearance_grid_, min, max));
}

}  // namespace nrff
