// The networks of NRFF on a tile of samples, forward and backward: spatial network, directional encoding, directional
// network, colour (model/nrff_field.h has the formulae). float, one thread, no allocation after Reserve.
//
// A tile keeps a feature's values of all its samples side by side, in rows of `stride` floats: every operation runs
// over samples in vectors, whatever the widths of the networks. All of a tile's rows together should stay in the
// second-level cache.
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "model/kernels/activation.h"
#include "model/kernels/directional_encoding.h"
#include "model/kernels/ree.h"
#include "model/kernels/tile_gemm.h"

namespace nrff {

// Weight [n_out, n_in] row by row, bias [n_out].
struct LinearLayer {
  int n_in = 0, n_out = 0;
  const float* weight = nullptr;
  const float* bias = nullptr;
  const PackedOperand *packed = nullptr, *packed_transposed = nullptr;  // of weight (PackedNetworks), or null
};

struct ShadingNetworks {
  bool decodes = false;  // whether spatial begins with a layer that no activation follows
  std::vector<LinearLayer> spatial, directional;
  DirectionalEncoding encoding = DirectionalEncoding::kRee;
  LinearLayer lobe_layer;  // shared by the rows of lobes; with kRee alone, as lobes
  Lobes lobes;
  int bottleneck_width = 0;
  Activation activation = Activation::kRelu;
};

// The weights made ready for the products of many tiles.
class PackedNetworks {
 public:
  // Points networks' layers to what it packs, which is theirs as long as the weights keep their values and this lives.
  // `backward`: also for Backward. `precision`: of Forward's products.
  void Pack(ShadingNetworks& networks, bool backward, GemmPrecision precision = GemmPrecision::kFloat);

 private:
  std::vector<PackedOperand> weights_;
};

// Sums of a thread's gradients of all layers' weights and biases. Rows of weights are padded.
class ShadingGradients {
 public:
  ShadingGradients() = default;
  explicit ShadingGradients(const ShadingNetworks& networks);

  struct Layer {
    float* weight = nullptr;  // [n_out][stride]
    int64_t stride = 0;
    float* bias = nullptr;  // [n_out]
  };
  // Spatial layers, the lobe layer where there is one, directional layers: the order of NrffField's parameters.
  const std::vector<Layer>& layers() const { return layers_; }
  void Clear();

 private:
  std::vector<float> values_;
  std::vector<Layer> layers_;
};

class ShadingTile {
 public:
  static constexpr int64_t kSamplesMultiple = 16;

  // `backward`: whether Backward will be called; without it a tile keeps less. `precision`: of Forward's products.
  ShadingTile(const ShadingNetworks& networks, bool backward, GemmPrecision precision = GemmPrecision::kFloat);

  // Room for so many samples.
  void Reserve(int64_t n_samples);
  int64_t stride() const { return stride_; }

  // Inputs of Forward, of n samples; rows up to the next multiple of kSamplesMultiple must hold finite numbers.
  float* features() { return Row(features_); }          // rows: the appearance grid's features
  float* ray_directions() { return Row(directions_); }  // 3 rows, unit
  // Outputs of Forward.
  const float* rgb() const { return Row(rgb_); }         // 3 rows
  const float* normals() const { return Row(normal_); }  // 3 rows; zero with DirectionalEncoding::kNone

  void Forward(const ShadingNetworks& networks, int64_t n);

  // Inputs of Backward, zero beyond n; it overwrites them.
  float* d_rgb() { return Row(d_rgb_); }
  float* d_normals() { return Row(d_normal_); }
  // Output of Backward, rows as features.
  const float* d_features() const { return Row(d_features_); }

  // After Forward on the same tile. Accumulates into gradients.
  void Backward(const ShadingNetworks& networks, int64_t n, const ShadingGradients& gradients);

 private:
  struct Hidden {
    int after, derivative;  // first rows: of the activation, of its derivative (with backward alone)
  };

  int AddRows(int n);
  float* Row(int row) { return values_.data() + offset_ + row * stride_; }
  const float* Row(int row) const { return values_.data() + offset_ + row * stride_; }

  void Encode(const ShadingNetworks& networks, int64_t n);
  void EncodeBackward(const ShadingNetworks& networks, int64_t n, std::span<const ShadingGradients::Layer> gradients);
  void ForwardLayer(const LinearLayer& layer, const float* input, int64_t n, float* output,
                    std::optional<Activation> activation = {}, float* derivative = nullptr) const;
  // The layers before `first_activated` are followed by no activation.
  void ForwardNetwork(const std::vector<LinearLayer>& layers, size_t first_activated, const std::vector<Hidden>& hidden,
                      int input, int output, Activation activation, int64_t n);
  // d_output → d_input, by way of the rows scratch_[0] and scratch_[1].
  void BackwardNetwork(const std::vector<LinearLayer>& layers, size_t first_activated,
                       const std::vector<Hidden>& hidden, int input, int d_output, int d_input, int64_t n,
                       std::span<const ShadingGradients::Layer> gradients);
  // derivative: of the activation that made `input`, or null.
  void BackwardLayer(const LinearLayer& layer, int input, const float* derivative, int d_output, int d_input, int64_t n,
                     const ShadingGradients::Layer& gradient);

  bool backward_;
  GemmPrecision precision_;
  int n_rows_ = 0;
  int64_t stride_ = 0, offset_ = 0;
  std::vector<float> values_, transposed_;
  int widest_ = 0;
  // First rows of what the tile keeps.
  int features_ = 0, directions_ = 0, spatial_out_ = 0, normal_ = 0, rgb_ = 0;
  int inverse_norm_ = 0, cosine_ = 0, reflected_ = 0, lobe_raw_ = 0, directional_in_ = 0, specular_ = 0;
  int d_rgb_ = 0, d_normal_ = 0, d_features_ = 0, d_spatial_out_ = 0, d_reflected_ = 0, d_lobe_raw_ = 0,
      d_directional_in_ = 0, d_specular_ = 0;  // with backward alone
  int scratch_[2];
  std::vector<Hidden> spatial_hidden_, directional_hidden_;
};

}  // namespace nrff
