// Time of every CPU kernel of a training step, on one thread, for the preset `small` and for the paper's model.
//
//   build/tests/kernels_bench --benchmark_out=OUT.json --benchmark_out_format=json
//
// Counters: samples/s; FLOP/s and bytes/s where the kernel is arithmetic or traffic by nature; `share` is that over
// what this machine does at its best, measured here first: fused multiply-adds on registers, bytes read from memory,
// 16-byte reads at random places of a table as large as the grid. Bytes of grids are what a sample reads of the
// parameters (24 or 48 products, three pairs of nodes each), forward.

#include <benchmark/benchmark.h>

#include <chrono>
#include <cmath>
#include <cstring>
#include <string>
#include <vector>

#include "model/kernels/adam.h"
#include "model/kernels/feature_grid.h"
#include "model/kernels/shading_tile.h"
#include "model/kernels/tile_gemm.h"
#include "model/kernels/tile_rows.h"
#include "render/kernels/compositing.h"
#include "render/kernels/random.h"
#include "render/kernels/sampling.h"

namespace nrff {
namespace {

using benchmark::Counter;
using benchmark::State;

std::vector<float> Uniforms(int64_t n, float low, float high, uint64_t stream) {
  std::vector<float> values(n);
  for (int64_t i = 0; i < n; ++i) values[i] = low + (high - low) * Uniform(1, stream, uint64_t(i));
  return values;
}

// Units of `work` per second, best of several.
template <typename Work>
double BestRate(double units, const Work& work) {
  double best = 0;
  for (int repeat = 0; repeat < 5; ++repeat) {
    const auto start = std::chrono::steady_clock::now();
    work();
    best = std::max(best, units / std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count());
  }
  return best;
}

// 24 x 64 sums that stay in registers, from operands that stay in the first-level cache.
double PeakFlops() {
  static const double peak = [] {
    const auto a = Uniforms(6 * 128, 0, 1, 1), b = Uniforms(128 * 64, 0, 1, 2);
    std::vector<float> c(6 * 64);
    constexpr int kTimes = 4000;
    return BestRate(2. * 6 * 64 * 128 * kTimes, [&] {
      for (int i = 0; i < kTimes; ++i) {
        TileGemm({.m = 6,
                  .n = 64,
                  .k = 128,
                  .a = a.data(),
                  .a_row = 128,
                  .a_column = 1,
                  .b = b.data(),
                  .b_row = 64,
                  .c = c.data(),
                  .c_row = 64,
                  .start = GemmStart::kZero});
        benchmark::DoNotOptimize(c.data());
      }
    });
  }();
  return peak;
}

double PeakBytes() {
  static const double peak = [] {
    const std::vector<uint64_t> memory(1 << 24, 1);
    return BestRate(double(memory.size()) * 8, [&] {
      uint64_t sum = 0;
      for (const uint64_t word : memory) sum += word;
      benchmark::DoNotOptimize(sum);
    });
  }();
  return peak;
}

// 16-byte reads from random places of a table of so many floats: bytes/s.
double PeakGather(int64_t n_floats) {
  const std::vector<float> table = Uniforms(n_floats + 4, 0, 1, 1);
  constexpr int64_t kReads = 1 << 16;
  std::vector<int32_t> places(kReads);
  for (int64_t i = 0; i < kReads; ++i) places[i] = int32_t(UniformBelow(uint64_t(n_floats), 1, 2, uint64_t(i)));
  return BestRate(16. * kReads, [&] {
    typedef float V __attribute__((vector_size(16)));
    V sums[4] = {};
    for (int64_t i = 0; i < kReads; i += 4) {
      for (int l = 0; l < 4; ++l) {
        V value;
        std::memcpy(&value, &table[places[i + l]], sizeof(V));
        sums[l] += value;
      }
    }
    benchmark::DoNotOptimize(sums);
  });
}

void Report(State& state, int64_t n_samples, double flops, double bytes, double peak) {
  const auto n = double(state.iterations());
  state.counters["samples/s"] = Counter(double(n_samples) * n, Counter::kIsRate);
  if (flops > 0) {
    state.counters["FLOP/s"] = Counter(flops * n, Counter::kIsRate);
    state.counters["share"] = Counter(flops * n / peak, Counter::kIsRate);
  }
  if (bytes > 0) {
    state.counters["bytes/s"] = Counter(bytes * n, Counter::kIsRate);
    state.counters["share"] = Counter(bytes * n / peak, Counter::kIsRate);
  }
}

// Neighbouring samples on rays through the middle of the box, as training has them.
std::vector<float> PointsOnRays(int64_t n) {
  std::vector<float> points(3 * n);
  for (int64_t i = 0; i < n; ++i) {
    const auto ray = uint64_t(i / 6);
    for (int k = 0; k < 3; ++k) {
      points[3 * i + k] =
          1.2F * (Uniform(1, 3, 3 * ray + k) - 0.5F) + float(i % 6) / 96 * (2 * Uniform(1, 4, 3 * ray + k) - 1);
    }
  }
  return points;
}

constexpr int64_t kPoints = 6144;

struct Grid {
  GridLayout layout;
  std::vector<float> parameters, gradient, points, features;
  Grid(bool paper, int channels)
      : layout(paper ? MakeGridLayout(16, 16, 512, channels) : MakeGridLayout(12, 16, 192, channels)),
        parameters(Uniforms(layout.n_parameters, -1, 1, 1)),
        gradient(parameters.size()),
        points(PointsOnRays(kPoints)),
        features(Uniforms(kPoints * layout.n_features(), -1, 1, 2)) {}
  double bytes_read() const { return double(kPoints) * layout.n_products() * 3 * 2 * layout.n_channels * 4; }
};

void DensityGridForward(State& state) {
  Grid grid(state.range(0) != 0, 2);
  for ([[maybe_unused]] auto _ : state) {
    GridSumForward(grid.layout, grid.parameters.data(), grid.points.data(), kPoints, grid.features.data());
  }
  Report(state, kPoints, 0, grid.bytes_read(), PeakGather(grid.layout.n_parameters));
}

void DensityGridBackward(State& state) {
  Grid grid(state.range(0) != 0, 2);
  for ([[maybe_unused]] auto _ : state) {
    for (int p = 0; p < grid.layout.n_products(); ++p) {
      GridSumBackward(grid.layout, p, grid.parameters.data(), grid.points.data(), kPoints, grid.features.data(),
                      grid.gradient.data());
    }
  }
  // Reads the parameters, reads and writes the gradient.
  Report(state, kPoints, 0, 3 * grid.bytes_read(), PeakGather(grid.layout.n_parameters));
}

void AppearanceGridForward(State& state) {
  Grid grid(state.range(0) != 0, 4);
  for ([[maybe_unused]] auto _ : state) {
    GridConcatForward(grid.layout, grid.parameters.data(), grid.points.data(), kPoints, grid.features.data());
  }
  Report(state, kPoints, 0, grid.bytes_read(), PeakGather(grid.layout.n_parameters));
}

void AppearanceGridBackward(State& state) {
  Grid grid(state.range(0) != 0, 4);
  for ([[maybe_unused]] auto _ : state) {
    for (int p = 0; p < grid.layout.n_products(); ++p) {
      GridConcatBackward(grid.layout, p, grid.parameters.data(), grid.points.data(), kPoints,
                         grid.features.data() + p * kPoints * 4, grid.gradient.data());
    }
  }
  Report(state, kPoints, 0, 3 * grid.bytes_read(), PeakGather(grid.layout.n_parameters));
}

// One layer: forward, the input's gradient, the weight's gradient with the transpose it needs.
void LinearForward(State& state) {
  const int64_t n_in = state.range(0), n_out = state.range(1), n = 224, row = n + 16;
  const auto weight = Uniforms(n_out * n_in, -1, 1, 1), x = Uniforms(n_in * row, -1, 1, 2),
             bias = Uniforms(n_out, 0, 1, 3);
  std::vector<float> y(n_out * row);
  for ([[maybe_unused]] auto _ : state) {
    TileGemm({.m = n_out,
              .n = n,
              .k = n_in,
              .a = weight.data(),
              .a_row = n_in,
              .a_column = 1,
              .b = x.data(),
              .b_row = row,
              .c = y.data(),
              .c_row = row,
              .start = GemmStart::kBias,
              .bias = bias.data()});
  }
  Report(state, n, 2. * double(n_in * n_out * n), 0, PeakFlops());
}

void LinearBackwardInput(State& state) {
  const int64_t n_in = state.range(0), n_out = state.range(1), n = 224, row = n + 16;
  const auto weight = Uniforms(n_out * n_in, -1, 1, 1), d_y = Uniforms(n_out * row, -1, 1, 2);
  std::vector<float> d_x(n_in * row);
  for ([[maybe_unused]] auto _ : state) {
    TileGemm({.m = n_in,
              .n = n,
              .k = n_out,
              .a = weight.data(),
              .a_row = 1,
              .a_column = n_in,
              .b = d_y.data(),
              .b_row = row,
              .c = d_x.data(),
              .c_row = row});
  }
  Report(state, n, 2. * double(n_in * n_out * n), 0, PeakFlops());
}

void LinearBackwardWeight(State& state) {
  const int64_t n_in = state.range(0), n_out = state.range(1), n = 224, row = n + 16;
  const int64_t padded = (n_in + 15) / 16 * 16, across = padded + 16;
  const auto x = Uniforms(padded * row, -1, 1, 1), d_y = Uniforms(n_out * row, -1, 1, 2);
  std::vector<float> transposed(n * across), d_weight(n_out * padded);
  for ([[maybe_unused]] auto _ : state) {
    TileGemmTransposed({.m = n_out,
                        .n = padded,
                        .k = n,
                        .a = d_y.data(),
                        .a_row = row,
                        .a_column = 1,
                        .b = x.data(),
                        .b_row = row,
                        .c = d_weight.data(),
                        .c_row = padded,
                        .start = GemmStart::kSum},
                       {transposed.data(), across});
  }
  Report(state, n, 2. * double(n_in * n_out * n), 0, PeakFlops());
}

// The networks of a preset, with parameters that live as long as this.
struct Networks {
  std::vector<std::vector<float>> parameters;
  ShadingNetworks networks;
  double flops = 0;  // forward, a sample

  LinearLayer Layer(int n_in, int n_out) {
    const float bound = 1 / std::sqrt(float(n_in));
    parameters.push_back(Uniforms(int64_t(n_in) * n_out, -bound, bound, parameters.size()));
    parameters.push_back(Uniforms(n_out, -bound, bound, parameters.size()));
    flops += 2. * n_in * n_out;
    return {n_in, n_out, parameters[parameters.size() - 2].data(), parameters.back().data()};
  }

  explicit Networks(bool paper) {
    const int width = paper ? 256 : 64, bottleneck = paper ? 128 : 32, row = 16, features = paper ? 192 : 144;
    networks.lobes = paper ? MakeLobes(8, 16) : MakeLobes(4, 8);
    networks.bottleneck_width = bottleneck;
    networks.activation = paper ? Activation::kGelu : Activation::kRelu;
    networks.spatial.push_back(Layer(features, width));
    if (paper) networks.spatial.push_back(Layer(width, width));
    networks.spatial.push_back(Layer(width, 9 + bottleneck + networks.lobes.n_theta * row));
    networks.directional.push_back(Layer(bottleneck + 2 * networks.lobes.size() + 1, width));
    for (int i = 0; i < (paper ? 4 : 1); ++i) networks.directional.push_back(Layer(width, width));
    networks.directional.push_back(Layer(width, 3));
    const double before = flops;
    networks.lobe_layer = Layer(row, networks.lobes.n_phi * kLobeParameters);
    flops = before + (flops - before) * networks.lobes.n_theta;
  }
};

// bf16: as pictures are made; float's peak all the same.
void Shading(State& state) {
  Networks made(state.range(0) != 0);
  const bool backward = state.range(1) != 0;
  const GemmPrecision precision = state.range(2) != 0 ? GemmPrecision::kBf16 : GemmPrecision::kFloat;
  PackedNetworks packed;
  packed.Pack(made.networks, backward, precision);
  constexpr int64_t kSamples = 224;
  ShadingTile tile(made.networks, backward, precision);
  tile.Reserve(kSamples);
  ShadingGradients gradients(made.networks);
  const auto features = Uniforms(made.networks.spatial.front().n_in * tile.stride(), -1, 1, 1);
  std::copy(features.begin(), features.end(), tile.features());
  std::fill_n(tile.ray_directions() + 2 * tile.stride(), kSamples, 1.F);
  tile.Forward(made.networks, kSamples);
  for ([[maybe_unused]] auto _ : state) {
    if (!backward) {
      tile.Forward(made.networks, kSamples);
      continue;
    }
    std::fill_n(tile.d_rgb(), 3 * tile.stride(), 0.1F);
    std::fill_n(tile.d_normals(), 3 * tile.stride(), 0.1F);
    tile.Backward(made.networks, kSamples, gradients);
  }
  Report(state, kSamples, (backward ? 2 : 1) * made.flops * kSamples, 0, PeakFlops());
}

void March(State& state) {
  constexpr int kResolution = 128;
  constexpr int64_t kRays = 4096, kCells = int64_t{kResolution} * kResolution * kResolution;
  // A shell of radius 0.7: what is occupied late in training.
  std::vector<uint64_t> cells(kCells / 64);
  std::vector<uint8_t> blocks(kCells / 512);
  OccupancyBits bits{kResolution, cells.data(), blocks.data()};
  for (int z = 0; z < kResolution; ++z) {
    for (int y = 0; y < kResolution; ++y) {
      for (int x = 0; x < kResolution; ++x) {
        const auto at = [](int i) { return (i + 0.5) * 2 / kResolution - 1; };
        if (std::abs(std::hypot(at(x), at(y), at(z)) - 0.7) > 0.03) continue;
        const size_t block = bits.BlockOf(x, y, z);
        blocks[block] = 1;
        cells[block * 8 + z % 8] |= uint64_t{1} << (8 * (y % 8) + x % 8);
      }
    }
  }
  std::vector<float> origins(3 * kRays), directions(3 * kRays);
  for (int64_t r = 0; r < kRays; ++r) {
    float d[3], norm = 0;
    for (int k = 0; k < 3; ++k) {
      origins[3 * r + k] = k == 2 ? -3.F : 0.F;
      d[k] = k == 2 ? 3.F : 1.6F * (Uniform(1, 1, uint64_t(2 * r + k)) - 0.5F);
      norm += d[k] * d[k];
    }
    for (int k = 0; k < 3; ++k) directions[3 * r + k] = d[k] / std::sqrt(norm);
  }
  const MarchArgs<float> args{.n_rays = kRays,
                              .origins = origins.data(),
                              .directions = directions.data(),
                              .occupancy = bits,
                              .map = {},
                              .step = 2. / 128,
                              .near = 0.1,
                              .far = 6};
  std::vector<int64_t> offsets(kRays + 1);
  int64_t n_samples = 0;
  for ([[maybe_unused]] auto _ : state) n_samples = CountSamplesCpu(args, offsets.data());
  Report(state, n_samples, 0, 0, 0);
  state.counters["rays/s"] = Counter(double(kRays) * double(state.iterations()), Counter::kIsRate);
}

struct Composited {
  static constexpr int64_t kRays = 1024, kPerRay = 8, kSamples = kRays * kPerRay;
  std::vector<int64_t> offsets = std::vector<int64_t>(kRays + 1), n_reached = std::vector<int64_t>(kRays);
  std::vector<float> sigma = Uniforms(kSamples, 0, 60, 1), delta = std::vector<float>(kSamples, 0.02F);
  std::vector<float> weights = sigma, d_sigma = sigma, d_weights = Uniforms(kSamples, -1, 1, 2);
  std::vector<float> transmittance = std::vector<float>(kRays), d_transmittance = Uniforms(kRays, -1, 1, 3);
  Composited() {
    for (int64_t r = 0; r <= kRays; ++r) offsets[r] = r * kPerRay;
  }
  void Forward() {
    WeightsForwardCpu(WeightsArgs<float>{.n_rays = kRays,
                                         .ray_offsets = offsets.data(),
                                         .sigma = sigma.data(),
                                         .delta = delta.data(),
                                         .stop_transmittance = 0,
                                         .weights = weights.data(),
                                         .transmittance = transmittance.data(),
                                         .n_reached = n_reached.data()});
  }
};

void WeightsForward(State& state) {
  Composited c;
  for ([[maybe_unused]] auto _ : state) c.Forward();
  Report(state, Composited::kSamples, 0, 0, 0);
}

void WeightsBackward(State& state) {
  Composited c;
  c.Forward();
  for ([[maybe_unused]] auto _ : state) {
    WeightsBackwardCpu(WeightsBackwardArgs<float>{.n_rays = Composited::kRays,
                                                  .ray_offsets = c.offsets.data(),
                                                  .delta = c.delta.data(),
                                                  .weights = c.weights.data(),
                                                  .transmittance = c.transmittance.data(),
                                                  .n_reached = c.n_reached.data(),
                                                  .dL_dweights = c.d_weights.data(),
                                                  .dL_dtransmittance = c.d_transmittance.data(),
                                                  .dL_dsigma = c.d_sigma.data()});
  }
  Report(state, Composited::kSamples, 0, 0, 0);
}

void Adam(State& state) {
  const int64_t n = state.range(0);
  std::vector<float> gradient = Uniforms(n, -1, 1, 1), parameters(n), m(n), v(n);
  int64_t t = 0;
  for ([[maybe_unused]] auto _ : state) AdamStep(AdamOptions{}, ++t, n, gradient.data(), parameters.data(), m.data(), v.data());
  Report(state, n, 0, 7. * 4 * double(n), PeakBytes());
}

#define NRFF_BENCH(name, ...) BENCHMARK(name)->Unit(benchmark::kMicrosecond) __VA_ARGS__
NRFF_BENCH(DensityGridForward, ->ArgName("paper")->Arg(0)->Arg(1));
NRFF_BENCH(DensityGridBackward, ->ArgName("paper")->Arg(0)->Arg(1));
NRFF_BENCH(AppearanceGridForward, ->ArgName("paper")->Arg(0)->Arg(1));
NRFF_BENCH(AppearanceGridBackward, ->ArgName("paper")->Arg(0)->Arg(1));
#define NRFF_LAYERS         \
  ->ArgNames({"in", "out"}) \
      ->Args({144, 64})     \
      ->Args({64, 105})     \
      ->Args({97, 64})      \
      ->Args({64, 64})      \
      ->Args({192, 256})    \
      ->Args({256, 256})    \
      ->Args({256, 265})    \
      ->Args({385, 256})
NRFF_BENCH(LinearForward, NRFF_LAYERS);
NRFF_BENCH(LinearBackwardInput, NRFF_LAYERS);
NRFF_BENCH(LinearBackwardWeight, NRFF_LAYERS);
NRFF_BENCH(Shading, ->ArgNames({"paper", "backward", "bf16"})
                        ->Args({0, 0, 0})
                        ->Args({0, 1, 0})
                        ->Args({1, 0, 0})
                        ->Args({1, 1, 0})
                        ->Args({0, 0, 1})
                        ->Args({1, 0, 1}));
NRFF_BENCH(March, );
NRFF_BENCH(WeightsForward, );
NRFF_BENCH(WeightsBackward, );
NRFF_BENCH(Adam, ->ArgName("n")->Arg(1 << 16)->Arg(1 << 20)->Arg(12800000));

}  // namespace
}  // namespace nrff

int main(int argc, char** argv) {
  benchmark::Initialize(&argc, argv);
  const auto giga = [](double x) { return std::to_string(x * 1e-9); };
  benchmark::AddCustomContext("peak_GFLOPs_one_core", giga(nrff::PeakFlops()));
  benchmark::AddCustomContext("peak_read_GBs_one_core", giga(nrff::PeakBytes()));
  benchmark::AddCustomContext("compiler", __VERSION__);
  benchmark::RunSpecifiedBenchmarks();
  return 0;
}
