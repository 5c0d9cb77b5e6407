#include <algorithm>
#include <cmath>
#include <cstring>

#include "model/kernels/fast_math.h"
#include "model/kernels/ree_lobe.h"
#include "model/kernels/reflection.h"
#include "model/kernels/shading_tile.h"
#include "model/kernels/simd.h"
#include "model/kernels/tile_gemm.h"

namespace nrff {
namespace {

// Rows are distinct: a sample's values depend on no other sample's.
#define NRFF_ROWS_DISTINCT _Pragma("GCC ivdep")

constexpr int kDiffuse = 0, kTint = 3, kNormal = 6, kBottleneck = 9;  // rows of the spatial network's output
constexpr int64_t kLine = 16;                                         // floats

int64_t RoundUp(int64_t n, int64_t multiple) { return (n + multiple - 1) / multiple * multiple; }

// Row length of transposed inputs and of weight gradients.
int64_t PaddedInputs(int n_in) { return RoundUp(n_in, kGemmColumns); }

NRFF_MULTIVERSION void SumRow(const float* row, int64_t n, float* sum) {
  float partial[kLine] = {};  // lanes, so that the order is fixed
  for (int64_t s = 0; s < n; s += kLine) {
    for (int64_t l = 0; l < kLine; ++l) partial[l] += row[s + l];
  }
  for (int64_t l = 0; l < kLine; ++l) *sum += partial[l];
}

// Rows `stride` apart.
NRFF_MULTIVERSION void Reflect(const float* raw, const float* direction, int64_t n, int64_t stride, float* normal,
                               float* inverse_norm, float* cosine, float* reflected) {
  NRFF_ROWS_DISTINCT
  for (int64_t s = 0; s < n; ++s) {
    const Reflection at(raw[s], raw[stride + s], raw[2 * stride + s], direction[s], direction[stride + s],
                        direction[2 * stride + s]);
    inverse_norm[s] = at.inverse_norm;
    cosine[s] = at.cosine;
    for (int k = 0; k < 3; ++k) {
      normal[k * stride + s] = at.normal[k];
      reflected[k * stride + s] = at.reflected[k];
    }
  }
}

// d_normal is what arrives at the normals from elsewhere.
NRFF_MULTIVERSION void ReflectBackward(const float* normal, const float* inverse_norm, const float* cosine,
                                       const float* direction, const float* d_cosine, const float* d_reflected,
                                       const float* d_normal, int64_t n, int64_t stride, float* d_raw) {
  NRFF_ROWS_DISTINCT
  for (int64_t s = 0; s < n; ++s) {
    const int64_t y = stride + s, z = 2 * stride + s;
    const float at_normal[3] = {normal[s], normal[y], normal[z]};
    const float at_direction[3] = {direction[s], direction[y], direction[z]};
    const float d_o[3] = {d_reflected[s], d_reflected[y], d_reflected[z]};
    const float d_n[3] = {d_normal[s], d_normal[y], d_normal[z]};
    float d[3];
    ReflectionBackward(at_normal, inverse_norm[s], cosine[s], at_direction, d_cosine[s], d_o, d_n, d);
    d_raw[s] = d[0];
    d_raw[y] = d[1];
    d_raw[z] = d[2];
  }
}

Lobe<float> LobeAt(const Lobes& lobes, int k) {
  return {float(lobes.sin_theta[k]), float(lobes.cos_theta[k]), float(lobes.sin_phi[k]), float(lobes.cos_phi[k])};
}

NRFF_MULTIVERSION void EncodeLobe(const Lobe<float>& lobe, const float* o, const float* raw, int64_t n, int64_t stride,
                                  float* encoding) {
  NRFF_ROWS_DISTINCT
  for (int64_t s = 0; s < n; ++s) {
    const LobeResponse<float> at(lobe, o[s], o[stride + s], o[2 * stride + s], raw[2 * stride + s],
                                 raw[3 * stride + s]);
    encoding[s] = raw[s] * at.response;
    encoding[stride + s] = raw[stride + s] * at.response;
  }
}

// d_o accumulates.
NRFF_MULTIVERSION void EncodeLobeBackward(const Lobe<float>& lobe, const float* o, const float* raw,
                                          const float* d_encoding, int64_t n, int64_t stride, float* d_o,
                                          float* d_raw) {
  NRFF_ROWS_DISTINCT
  for (int64_t s = 0; s < n; ++s) {
    const LobeResponse<float> at(lobe, o[s], o[stride + s], o[2 * stride + s], raw[2 * stride + s],
                                 raw[3 * stride + s]);
    const LobeGradient<float> d(lobe, at, raw[s], raw[stride + s], d_encoding[s], d_encoding[stride + s]);
    d_raw[s] = d.d_a0;
    d_raw[stride + s] = d.d_a1;
    d_raw[2 * stride + s] = d.d_raw_lambda;
    d_raw[3 * stride + s] = d.d_raw_mu;
    d_o[s] += d.d_x;
    d_o[stride + s] += d.d_y;
    d_o[2 * stride + s] += d.d_z;
  }
}

// rgb = sigmoid(diffuse + tint ⊙ specular), row by row.
NRFF_MULTIVERSION void Colour(const float* diffuse, const float* tint, const float* specular, int64_t n, float* rgb) {
  NRFF_ROWS_DISTINCT
  for (int64_t s = 0; s < n; ++s) rgb[s] = FastSigmoid(diffuse[s] + tint[s] * specular[s]);
}

NRFF_MULTIVERSION void DiffuseColour(const float* diffuse, int64_t n, float* rgb) {
  NRFF_ROWS_DISTINCT
  for (int64_t s = 0; s < n; ++s) rgb[s] = FastSigmoid(diffuse[s]);
}

NRFF_MULTIVERSION void ColourBackward(const float* tint, const float* specular, const float* rgb, const float* d_rgb,
                                      int64_t n, float* d_diffuse, float* d_tint, float* d_specular) {
  NRFF_ROWS_DISTINCT
  for (int64_t s = 0; s < n; ++s) {
    const float d = d_rgb[s] * rgb[s] * (1 - rgb[s]);
    d_diffuse[s] = d;
    d_tint[s] = d * specular[s];
    d_specular[s] = d * tint[s];
  }
}

NRFF_MULTIVERSION void DiffuseColourBackward(const float* rgb, const float* d_rgb, int64_t n, float* d_diffuse) {
  NRFF_ROWS_DISTINCT
  for (int64_t s = 0; s < n; ++s) d_diffuse[s] = d_rgb[s] * rgb[s] * (1 - rgb[s]);
}

// Pointers to them, in the order of ShadingGradients::layers.
template <typename Networks>
auto LayersOf(Networks& networks) {
  std::vector<decltype(&networks.lobe_layer)> layers;
  for (auto& layer : networks.spatial) layers.push_back(&layer);
  if (networks.encoding == DirectionalEncoding::kRee) layers.push_back(&networks.lobe_layer);
  for (auto& layer : networks.directional) layers.push_back(&layer);
  return layers;
}

}  // namespace

void PackedNetworks::Pack(ShadingNetworks& networks, bool backward, GemmPrecision precision) {
  const auto layers = LayersOf(networks);
  weights_.resize(2 * layers.size());
  for (size_t l = 0; l < layers.size(); ++l) {
    LinearLayer& layer = *layers[l];
    weights_[2 * l].Pack({.m = layer.n_out,
                          .k = layer.n_in,
                          .a = layer.weight,
                          .a_row = layer.n_in,
                          .a_column = 1,
                          .precision = precision});
    layer.packed = &weights_[2 * l];
    layer.packed_transposed = nullptr;
    if (!backward) continue;
    weights_[2 * l + 1].Pack(
        {.m = layer.n_in, .k = layer.n_out, .a = layer.weight, .a_row = 1, .a_column = layer.n_in});
    layer.packed_transposed = &weights_[2 * l + 1];
  }
}

ShadingGradients::ShadingGradients(const ShadingNetworks& networks) {
  const auto layers = LayersOf(networks);
  int64_t n = 0;
  for (const LinearLayer* layer : layers) n += layer->n_out * (PaddedInputs(layer->n_in) + 1);
  values_.assign(n, 0.F);
  float* next = values_.data();
  for (const LinearLayer* layer : layers) {
    const int64_t stride = PaddedInputs(layer->n_in);
    layers_.push_back({next, stride, next + layer->n_out * stride});
    next += layer->n_out * (stride + 1);
  }
}

void ShadingGradients::Clear() { std::fill(values_.begin(), values_.end(), 0.F); }

ShadingTile::ShadingTile(const ShadingNetworks& networks, bool backward, GemmPrecision precision)
    : backward_(backward), precision_(precision) {
  const bool directional = networks.encoding != DirectionalEncoding::kNone;
  const int n_directional_in = directional ? networks.directional.front().n_in : 0;
  const int n_lobes = networks.lobes.size();
  const auto add_hidden = [this](const std::vector<LinearLayer>& layers, std::vector<Hidden>& hidden) {
    for (const LinearLayer& layer : layers) {
      widest_ = std::max({widest_, layer.n_in, layer.n_out});
      if (&layer == &layers.back() || !backward_) continue;
      const int derivative = AddRows(layer.n_out);
      hidden.push_back({AddRows(layer.n_out), derivative});
    }
  };
  features_ = AddRows(networks.spatial.front().n_in);
  directions_ = AddRows(3);
  add_hidden(networks.spatial, spatial_hidden_);
  spatial_out_ = AddRows(networks.spatial.back().n_out);
  normal_ = AddRows(3);
  if (directional) {
    inverse_norm_ = AddRows(1);
    reflected_ = AddRows(3);
    lobe_raw_ = AddRows(n_lobes * kLobeParameters);
    directional_in_ = AddRows(n_directional_in);
    cosine_ = directional_in_ + n_directional_in - 1;
    add_hidden(networks.directional, directional_hidden_);
    specular_ = AddRows(3);
  }
  rgb_ = AddRows(3);
  for (int& scratch : scratch_) scratch = AddRows(widest_);
  if (!backward_) {
    // Nothing is kept, so that the rows stay in the cache.
    for (auto [layers, hidden] :
         {std::pair(&networks.spatial, &spatial_hidden_), std::pair(&networks.directional, &directional_hidden_)}) {
      for (size_t i = 0; i + 1 < layers->size(); ++i) hidden->push_back({scratch_[i % 2], -1});
    }
    return;
  }
  d_rgb_ = AddRows(3);
  d_normal_ = AddRows(3);
  d_features_ = AddRows(networks.spatial.front().n_in);
  d_spatial_out_ = AddRows(networks.spatial.back().n_out);
  if (!directional) return;
  d_reflected_ = AddRows(3);
  d_lobe_raw_ = AddRows(n_lobes * kLobeParameters);
  d_directional_in_ = AddRows(n_directional_in);
  d_specular_ = AddRows(3);
}

// Row counts are multiples of 4, for TileTranspose.
int ShadingTile::AddRows(int n) {
  const int first = n_rows_;
  n_rows_ += int(RoundUp(n, 4));
  return first;
}

void ShadingTile::Reserve(int64_t n_samples) {
  // Not a multiple of a power of two, so that a column of the tile does not fall into few sets of the cache.
  const int64_t stride = RoundUp(n_samples, 2 * kLine) + kLine;
  if (stride <= stride_) return;
  stride_ = stride;
  values_.assign(n_rows_ * stride + kLine, 0.F);
  offset_ = int64_t((64 - reinterpret_cast<uintptr_t>(values_.data()) % 64) % 64 / sizeof(float));
  if (backward_) transposed_.assign(stride * (PaddedInputs(widest_) + kLine), 0.F);
}

void ShadingTile::ForwardLayer(const LinearLayer& layer, const float* input, int64_t n, float* output,
                               std::optional<Activation> activation, float* derivative) const {
  TileGemm({.m = layer.n_out,
            .n = n,
            .k = layer.n_in,
            .a = layer.weight,
            .a_row = layer.n_in,
            .a_column = 1,
            .packed_a = layer.packed,
            .b = input,
            .b_row = stride_,
            .c = output,
            .c_row = stride_,
            .start = GemmStart::kBias,
            .bias = layer.bias,
            .activation = activation,
            .derivative = derivative,
            .precision = precision_});
}

void ShadingTile::ForwardNetwork(const std::vector<LinearLayer>& layers, size_t first_activated,
                                 const std::vector<Hidden>& hidden, int input, int output, Activation activation,
                                 int64_t n) {
  for (size_t i = 0; i < layers.size(); ++i) {
    const bool last = i + 1 == layers.size();
    const float* from = Row(i == 0 ? input : hidden[i - 1].after);
    float* to = Row(last ? output : hidden[i].after);
    if (last || i < first_activated) {
      ForwardLayer(layers[i], from, n, to);
    } else {
      ForwardLayer(layers[i], from, n, to, activation, backward_ ? Row(hidden[i].derivative) : nullptr);
    }
  }
}

void ShadingTile::Forward(const ShadingNetworks& networks, int64_t n_samples) {
  const int64_t n = RoundUp(n_samples, kSamplesMultiple);
  ForwardNetwork(networks.spatial, networks.decodes ? 1 : 0, spatial_hidden_, features_, spatial_out_,
                 networks.activation, n);
  const float* out = Row(spatial_out_);
  if (networks.encoding == DirectionalEncoding::kNone) {
    for (int c = 0; c < 3; ++c) DiffuseColour(out + (kDiffuse + c) * stride_, n, Row(rgb_ + c));
    return;
  }
  Reflect(out + kNormal * stride_, Row(directions_), n, stride_, Row(normal_), Row(inverse_norm_), Row(cosine_),
          Row(reflected_));
  for (int r = 0; r < networks.bottleneck_width; ++r) {
    std::memcpy(Row(directional_in_ + r), out + (kBottleneck + r) * stride_, n * sizeof(float));
  }
  Encode(networks, n);
  ForwardNetwork(networks.directional, 0, directional_hidden_, directional_in_, specular_, networks.activation, n);
  for (int c = 0; c < 3; ++c) {
    Colour(out + (kDiffuse + c) * stride_, out + (kTint + c) * stride_, Row(specular_ + c), n, Row(rgb_ + c));
  }
}

// What the spatial network leaves for it lies behind the bottleneck; so does the encoding in the directional input.
void ShadingTile::Encode(const ShadingNetworks& networks, int64_t n) {
  const int share = spatial_out_ + kBottleneck + networks.bottleneck_width;
  const int encoding = directional_in_ + networks.bottleneck_width;
  if (networks.encoding == DirectionalEncoding::kIde) {
    IdeForwardRows(Row(reflected_), Row(share), n, stride_, Row(encoding));
  } else if (networks.encoding == DirectionalEncoding::kPe) {
    PeForwardRows(Row(directions_), n, stride_, Row(encoding));
  } else {
    const LinearLayer& lobe_layer = networks.lobe_layer;
    for (int row = 0; row < networks.lobes.n_theta; ++row) {
      ForwardLayer(lobe_layer, Row(share + row * lobe_layer.n_in), n, Row(lobe_raw_ + row * lobe_layer.n_out));
    }
    for (int k = 0; k < networks.lobes.size(); ++k) {
      EncodeLobe(LobeAt(networks.lobes, k), Row(reflected_), Row(lobe_raw_ + k * kLobeParameters), n, stride_,
                 Row(encoding + k * kLobeAmplitudes));
    }
  }
}

void ShadingTile::BackwardLayer(const LinearLayer& layer, int input, const float* derivative, int d_output, int d_input,
                                int64_t n, const ShadingGradients::Layer& gradient) {
  const int64_t padded = PaddedInputs(layer.n_in);
  TileGemmTransposed({.m = layer.n_out,
                      .n = padded,
                      .k = n,
                      .a = Row(d_output),
                      .a_row = stride_,
                      .a_column = 1,
                      .b = Row(input),
                      .b_row = stride_,
                      .c = gradient.weight,
                      .c_row = gradient.stride,
                      .start = GemmStart::kSum},
                     {transposed_.data(), padded + kLine});
  for (int r = 0; r < layer.n_out; ++r) SumRow(Row(d_output + r), n, gradient.bias + r);
  TileGemm({.m = layer.n_in,
            .n = n,
            .k = layer.n_out,
            .a = layer.weight,
            .a_row = 1,
            .a_column = layer.n_in,
            .packed_a = layer.packed_transposed,
            .b = Row(d_output),
            .b_row = stride_,
            .c = Row(d_input),
            .c_row = stride_,
            .factor = derivative});
}

void ShadingTile::BackwardNetwork(const std::vector<LinearLayer>& layers, size_t first_activated,
                                  const std::vector<Hidden>& hidden, int input, int d_output, int d_input, int64_t n,
                                  std::span<const ShadingGradients::Layer> gradients) {
  int d = d_output;
  for (int i = int(layers.size()) - 1; i >= 0; --i) {
    const int next = i == 0 ? d_input : scratch_[i % 2];
    const bool activated = i > int(first_activated);
    BackwardLayer(layers[i], i == 0 ? input : hidden[i - 1].after, activated ? Row(hidden[i - 1].derivative) : nullptr,
                  d, next, n, gradients[i]);
    d = next;
  }
}

void ShadingTile::Backward(const ShadingNetworks& networks, int64_t n_samples, const ShadingGradients& gradients) {
  const int64_t n = RoundUp(n_samples, kSamplesMultiple);
  const std::span<const ShadingGradients::Layer> layers(gradients.layers());
  const size_t n_spatial = networks.spatial.size(), n_directional = networks.directional.size();
  if (networks.encoding == DirectionalEncoding::kNone) {
    for (int c = 0; c < 3; ++c)
      DiffuseColourBackward(Row(rgb_ + c), Row(d_rgb_ + c), n, Row(d_spatial_out_ + kDiffuse + c));
  } else {
    for (int c = 0; c < 3; ++c) {
      ColourBackward(Row(spatial_out_ + kTint + c), Row(specular_ + c), Row(rgb_ + c), Row(d_rgb_ + c), n,
                     Row(d_spatial_out_ + kDiffuse + c), Row(d_spatial_out_ + kTint + c), Row(d_specular_ + c));
    }
    BackwardNetwork(networks.directional, 0, directional_hidden_, directional_in_, d_specular_, d_directional_in_, n,
                    layers.last(n_directional));
    for (int r = 0; r < networks.bottleneck_width; ++r) {
      std::memcpy(Row(d_spatial_out_ + kBottleneck + r), Row(d_directional_in_ + r), n * sizeof(float));
    }
    EncodeBackward(networks, n, layers.subspan(n_spatial, layers.size() - n_spatial - n_directional));
    ReflectBackward(Row(normal_), Row(inverse_norm_), Row(cosine_), Row(directions_),
                    Row(d_directional_in_ + cosine_ - directional_in_), Row(d_reflected_), Row(d_normal_), n, stride_,
                    Row(d_spatial_out_ + kNormal));
  }
  BackwardNetwork(networks.spatial, networks.decodes ? 1 : 0, spatial_hidden_, features_, d_spatial_out_, d_features_,
                  n, layers.first(n_spatial));
}

// gradients: of the encoding's own layers.
void ShadingTile::EncodeBackward(const ShadingNetworks& networks, int64_t n,
                                 std::span<const ShadingGradients::Layer> gradients) {
  const int share = kBottleneck + networks.bottleneck_width;
  const int d_encoding = d_directional_in_ + networks.bottleneck_width;
  if (networks.encoding == DirectionalEncoding::kIde) {
    IdeBackwardRows(Row(reflected_), Row(spatial_out_ + share), Row(d_encoding), n, stride_, Row(d_reflected_),
                    Row(d_spatial_out_ + share));
    return;
  }
  for (int k = 0; k < 3; ++k) std::fill_n(Row(d_reflected_ + k), n, 0.F);
  if (networks.encoding == DirectionalEncoding::kPe) return;  // rays are given
  for (int k = 0; k < networks.lobes.size(); ++k) {
    EncodeLobeBackward(LobeAt(networks.lobes, k), Row(reflected_), Row(lobe_raw_ + k * kLobeParameters),
                       Row(d_encoding + k * kLobeAmplitudes), n, stride_, Row(d_reflected_),
                       Row(d_lobe_raw_ + k * kLobeParameters));
  }
  const LinearLayer& lobe_layer = networks.lobe_layer;
  for (int row = 0; row < networks.lobes.n_theta; ++row) {
    const int lobe_features = share + row * lobe_layer.n_in;
    BackwardLayer(lobe_layer, spatial_out_ + lobe_features, nullptr, d_lobe_raw_ + row * lobe_layer.n_out,
                  d_spatial_out_ + lobe_features, n, gradients[0]);
  }
}

}  // namespace nrff
