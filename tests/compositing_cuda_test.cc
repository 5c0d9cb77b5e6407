// The CUDA twins of the compositing kernels give what the CPU ones give, also where light is all or nothing. Skipped,
// visibly, where there is no GPU.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <random>
#include <vector>

#include "render/kernels/compositing.h"
#include "tests/device_array.h"

namespace nrff {
namespace {

// `scale`: of what the value is a sum of, by index; the error is relative to it.
template <typename Scalar, typename Scale>
void ExpectClose(const std::vector<Scalar>& cuda, const std::vector<Scalar>& cpu, const char* what, Scale scale) {
  ASSERT_EQ(cuda.size(), cpu.size());
  // exp and expm1 differ by 1 to 2 ulp between the two, and a ray adds up 64 of them.
  const double tolerance = 128 * double(std::numeric_limits<Scalar>::epsilon());
  for (size_t i = 0; i < cuda.size(); ++i) ASSERT_NEAR(cuda[i], cpu[i], tolerance * scale(i)) << what << " " << i;
}

template <typename Scalar>
class CompositingCuda : public ::testing::Test {};
using Scalars = ::testing::Types<float, double>;
TYPED_TEST_SUITE(CompositingCuda, Scalars);

TYPED_TEST(CompositingCuda, IsItsCpuTwin) {
  using Scalar = TypeParam;
  if (!HasGpu()) GTEST_SKIP() << "no GPU";
  constexpr int64_t kRays = 1000, kChannels = 3;
  std::mt19937 random(3);
  std::uniform_real_distribution<double> uniform(-1, 1);
  std::vector<int64_t> offsets = {0};
  for (int64_t r = 0; r < kRays; ++r) offsets.push_back(offsets.back() + int64_t(random() % 65));
  const auto n = size_t(offsets.back());
  const auto draw = [&](size_t size, auto value) {
    std::vector<Scalar> values(size);
    for (Scalar& v : values) v = Scalar(value());
    return values;
  };
  const auto sigma = draw(n, [&] { return std::pow(10., 8 * uniform(random)); });
  const auto delta = draw(n, [&] { return 0.01; });
  const auto values = draw(n * kChannels, [&] { return uniform(random); });
  const auto d_weights = draw(n, [&] { return uniform(random); });
  const auto d_transmittance = draw(kRays, [&] { return uniform(random); });
  const auto d_out = draw(kRays * kChannels, [&] { return uniform(random); });

  const DeviceArray<int64_t> d_offsets(offsets);
  const DeviceArray<Scalar> g_sigma(sigma), g_delta(delta), g_values(values), g_d_weights(d_weights),
      g_d_transmittance(d_transmittance), g_d_out(d_out);
  for (const Scalar stop : {Scalar(0), Scalar(1e-4)}) {
    std::vector<Scalar> weights(n), transmittance(kRays), d_sigma(n), out(kRays * kChannels), d_w(n),
        d_v(n * kChannels);
    std::vector<int64_t> n_reached(kRays);
    const DeviceArray<Scalar> g_weights(weights), g_transmittance(transmittance), g_d_sigma(d_sigma), g_out(out),
        g_d_w(d_w), g_d_v(d_v);
    const DeviceArray<int64_t> g_n_reached(n_reached);
    WeightsForwardCpu(WeightsArgs<Scalar>{kRays, offsets.data(), sigma.data(), delta.data(), stop, weights.data(),
                                          transmittance.data(), n_reached.data()});
    WeightsForwardCuda(WeightsArgs<Scalar>{kRays, d_offsets.get(), g_sigma.get(), g_delta.get(), stop, g_weights.get(),
                                           g_transmittance.get(), g_n_reached.get()},
                       nullptr);
    WeightsBackwardCpu(WeightsBackwardArgs<Scalar>{kRays, offsets.data(), delta.data(), weights.data(),
                                                   transmittance.data(), n_reached.data(), d_weights.data(),
                                                   d_transmittance.data(), d_sigma.data()});
    WeightsBackwardCuda(
        WeightsBackwardArgs<Scalar>{kRays, d_offsets.get(), g_delta.get(), g_weights.get(), g_transmittance.get(),
                                    g_n_reached.get(), g_d_weights.get(), g_d_transmittance.get(), g_d_sigma.get()},
        nullptr);
    AccumulateForwardCpu(
        AccumulateArgs<Scalar>{kRays, kChannels, offsets.data(), weights.data(), values.data(), out.data()});
    AccumulateForwardCuda(
        AccumulateArgs<Scalar>{kRays, kChannels, d_offsets.get(), g_weights.get(), g_values.get(), g_out.get()},
        nullptr);
    AccumulateBackwardCpu(AccumulateBackwardArgs<Scalar>{kRays, kChannels, offsets.data(), weights.data(),
                                                         values.data(), d_out.data(), d_w.data(), d_v.data()});
    AccumulateBackwardCuda(AccumulateBackwardArgs<Scalar>{kRays, kChannels, d_offsets.get(), g_weights.get(),
                                                          g_values.get(), g_d_out.get(), g_d_w.get(), g_d_v.get()},
                           nullptr);
    CheckCuda(cudaDeviceSynchronize());
    EXPECT_EQ(g_n_reached.Host(), n_reached);
    const auto one = [](size_t) { return 1.; };
    const double least = std::numeric_limits<Scalar>::min();
    // T is the exponential of a sum of τ: its relative error is the absolute one of the sum, which is below 100 where T
    // is a normal number. A weight T·α keeps its own precision, however small α is.
    ExpectClose(g_weights.Host(), weights, "weight", [&](size_t i) { return 100 * std::abs(weights[i]) + least; });
    ExpectClose(g_transmittance.Host(), transmittance, "transmittance",
                [&](size_t i) { return 100 * std::abs(transmittance[i]) + least; });
    ExpectClose(g_d_sigma.Host(), d_sigma, "dL/dsigma", [&](size_t i) { return double(delta[i]); });
    ExpectClose(g_out.Host(), out, "sum", one);
    ExpectClose(g_d_w.Host(), d_w, "dL/dweight", one);
    ExpectClose(g_d_v.Host(), d_v, "dL/dvalue", [&](size_t i) { return double(weights[i / kChannels]) + least; });
  }
}

}  // namespace
}  // namespace nrff
