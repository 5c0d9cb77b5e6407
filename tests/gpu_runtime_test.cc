// What the host decides for a GPU: when a step is a graph, how much memory it gets, and what there is to do without.

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <omp.h>

#include <cmath>
#include <limits>
#include <numeric>

#include "model/cuda/gpu_room.h"
#include "render/kernels/device_runtime.h"
#include "tests/emulation/device_emulation.h"

namespace nrff::device {
namespace {

class Runtime : public ::testing::Test {
 protected:
  void SetUp() override { SetEmulatedMemory(size_t{1} << 34); }
  Stream stream_;
};

struct AddOne {
  float* values;
  NRFF_HOST_DEVICE void operator()(int64_t i) const { values[i] += 1; }
};

TEST_F(Runtime, AGraphDoesItsWorkWhenLaunchedNotWhenCaptured) {
  const Buffer<float> values(1000);
  Zero(values.data(), 4000, stream_.get());
  Graph graph;
  EXPECT_FALSE(graph.captured());
  graph.Capture(stream_.get(), [&] { ForEach("add", 1000, stream_.get(), AddOne{values.data()}); });
  EXPECT_TRUE(graph.captured());
  std::vector<float> host(1000);
  const auto sum = [&] {
    CopyToHost(host.data(), values.data(), 4000, stream_.get());
    stream_.Synchronize();
    return std::accumulate(host.begin(), host.end(), 0.F);
  };
  EXPECT_EQ(sum(), 0);
  graph.Launch(stream_.get());
  graph.Launch(stream_.get());
  EXPECT_EQ(sum(), 2000);
}

TEST_F(Runtime, WhatAGraphCannotHoldIsRefused) {
  const Buffer<float> values(8);
  const PinnedBuffer<float> pinned(8);
  std::vector<float> host(8);
  const auto refused = [&](const std::function<void()>& work) {
    Graph graph;
    EXPECT_THROW(graph.Capture(stream_.get(), work), DeviceError);
    EXPECT_FALSE(graph.captured());
  };
  refused([&] { stream_.Synchronize(); });
  refused([&] { Allocate(8); });
  refused([&] { CopyToHost(host.data(), values.data(), 32, stream_.get()); });
  refused([&] { CopyToDevice(values.data(), host.data(), 32, stream_.get()); });
  refused([&] { Mark().Wait(); });
  Graph graph;
  graph.Capture(stream_.get(), [&] { CopyToHost(pinned.data(), values.data(), 32, stream_.get()); });
  EXPECT_TRUE(graph.captured());
  stream_.Synchronize();  // a capture that failed leaves nothing behind
}

TEST_F(Runtime, TheTwoMemoriesAreKeptApart) {
  const Buffer<float> values(8), others(8);
  std::vector<float> host(8);
  EXPECT_THROW(Zero(host.data(), 32, stream_.get()), DeviceError);
  EXPECT_THROW(CopyToDevice(host.data(), host.data(), 32, stream_.get()), DeviceError);
  EXPECT_THROW(CopyToDevice(values.data(), others.data(), 32, stream_.get()), DeviceError);
  EXPECT_THROW(CopyToHost(values.data(), others.data(), 32, stream_.get()), DeviceError);
  EXPECT_THROW(Zero(values.data(), 64, stream_.get()), DeviceError);  // beyond its end
}

TEST_F(Runtime, MemoryThatThereIsNotIsSaidWithItsSize) {
  SetEmulatedMemory(size_t{8} << 20);
  try {
    const Buffer<char> too_much(int64_t{9} << 20);
    FAIL() << "was allocated";
  } catch (const OutOfDeviceMemory& error) {
    EXPECT_THAT(error.what(), ::testing::HasSubstr("9 MiB were asked for, 8 MiB are free"));
  }
}

TEST_F(Runtime, SumsAndProductsAreRight) {
  const std::vector<int64_t> counts{3, 0, 5, 1};
  const Buffer<int64_t> values(4), sums(5);
  const Buffer<char> scratch(static_cast<int64_t>(ScratchOfSums(4)));
  CopyToDevice(values.data(), counts.data(), 32, stream_.get());
  ExclusiveSums(values.data(), 4, sums.data(), scratch.data(), ScratchOfSums(4), stream_.get());
  std::vector<int64_t> found(5);
  CopyToHost(found.data(), sums.data(), 40, stream_.get());
  stream_.Synchronize();
  EXPECT_EQ(found, (std::vector<int64_t>{0, 3, 3, 8, 9}));

  // In all four layouts of A (16 × 8) and B (8 × 24).
  constexpr int m = 16, n = 24, k = 8;
  std::vector<float> a(m * k), b(k * n), c(m * n);
  for (int i = 0; i < m * k; ++i) a[i] = static_cast<float>(i % 7 - 3);
  for (int i = 0; i < k * n; ++i) b[i] = static_cast<float>(i % 5 - 2);
  const Buffer<float> on_a(m * k), on_b(k * n), on_c(m * n);
  const Matmul matmul(stream_.get());
  for (const bool a_transposed : {false, true}) {
    for (const bool b_transposed : {false, true}) {
      CopyToDevice(on_a.data(), a.data(), sizeof(float) * a.size(), stream_.get());
      CopyToDevice(on_b.data(), b.data(), sizeof(float) * b.size(), stream_.get());
      MatmulArgs<float> args{
          m, n, k, on_a.data(), a_transposed ? m : k, a_transposed, on_b.data(), b_transposed ? k : n, b_transposed};
      args.c = on_c.data();
      args.c_row = n;
      matmul(args);
      CopyToHost(c.data(), on_c.data(), sizeof(float) * c.size(), stream_.get());
      stream_.Synchronize();
      for (int i = 0; i < m; ++i) {
        for (int j = 0; j < n; ++j) {
          float expected = 0;
          for (int l = 0; l < k; ++l) {
            expected += a[a_transposed ? l * m + i : i * k + l] * b[b_transposed ? j * k + l : l * n + j];
          }
          ASSERT_EQ(c[i * n + j], expected) << i << " " << j;
        }
      }
    }
  }
}

TEST_F(Runtime, AProfileHasEveryKindOfWork) {
  const Buffer<float> values(1000);
  Zero(values.data(), 4000, stream_.get());
  StartProfile();
  for (int i = 0; i < 3; ++i) ForEach("add", 1000, stream_.get(), AddOne{values.data()});
  const auto works = EndProfile();
  ASSERT_EQ(works.size(), 1);
  EXPECT_EQ(works.at("add").n, 3);
  EXPECT_GT(works.at("add").milliseconds, 0);
}

TEST(DeviceNumbers, RoundToTheNearestAndTiesToEven) {
  const auto bf16 = [](float x) {
    Bf16 number;
    FromFloat(x, number);
    return ToFloat(number);
  };
  const auto half = [](float x) {
    Half number;
    FromFloat(x, number);
    return ToFloat(number);
  };
  EXPECT_EQ(bf16(1 + 0x1p-8F), 1);            // a tie, to the even one below
  EXPECT_EQ(bf16(1 + 0x3p-8F), 1 + 0x1p-6F);  // a tie, to the even one above
  EXPECT_EQ(bf16(1 + 0x1.1p-8F), 1 + 0x1p-7F);
  EXPECT_EQ(bf16(-3e38F), -0x1.c4p127F);
  EXPECT_EQ(bf16(std::numeric_limits<float>::max()), std::numeric_limits<float>::infinity());
  EXPECT_TRUE(std::isnan(bf16(std::numeric_limits<float>::quiet_NaN())));
  EXPECT_EQ(half(1 + 0x1p-11F), 1);
  EXPECT_EQ(half(1 + 0x3p-11F), 1 + 0x1p-9F);
  EXPECT_EQ(half(65504), 65504);
  EXPECT_EQ(half(1e6F), std::numeric_limits<float>::infinity());
  EXPECT_EQ(half(-65519), -65504);
  EXPECT_EQ(half(-65520), -std::numeric_limits<float>::infinity());
  EXPECT_EQ(half(0x1p-24F), 0x1p-24F);  // a denormal
  EXPECT_EQ(half(-0x3p-25F), -0x1p-23F);
  EXPECT_EQ(half(0x1p-25F), 0);
  EXPECT_TRUE(std::isnan(half(std::numeric_limits<float>::quiet_NaN())));
  // Every half is itself.
  for (uint32_t bits = 0; bits < 0x10000; ++bits) {
    const Half number{static_cast<uint16_t>(bits)};
    const float value = ToFloat(number);
    if (std::isnan(value)) continue;
    ASSERT_EQ(half(value), value) << bits;
  }
}

TEST(GpuRoom, GrowsToWhatWasFoundAndShrinksToWhatIsUsed) {
  GpuRoomPlan plan({1000, 8192, 4096});
  EXPECT_FALSE(plan.Observe(plan.room(), 8000, 4000));
  EXPECT_TRUE(plan.Observe(plan.room(), 20000, 4000));
  EXPECT_GE(plan.room().samples, 24000);
  EXPECT_EQ(plan.room().samples % 4096, 0);
  EXPECT_EQ(plan.room().shaded, 4096);
  const GpuRoom grown = plan.room();
  EXPECT_FALSE(plan.Observe({1000, 8192, 4096}, 20000, 4000));  // a step queued before the room was made
  EXPECT_EQ(plan.room(), grown);
  bool shrank = false;
  for (int i = 0; i < 2000; ++i) shrank = plan.Observe(plan.room(), 5000, 100) || shrank;
  EXPECT_TRUE(shrank);
  EXPECT_EQ(plan.room().samples, 8192);
  EXPECT_EQ(plan.room().rays, 1000);
  for (int i = 0; i < 2000; ++i) EXPECT_FALSE(plan.Observe(plan.room(), 5000, 100));  // and stays
}

TEST(GpuRoom, HalvesUntilThereIsNothingLeftToHalve) {
  GpuRoomPlan plan({1000, 65536, 65536});
  EXPECT_TRUE(plan.Halve());
  EXPECT_EQ(plan.most_rays(), 500);
  EXPECT_EQ(plan.room(), (GpuRoom{500, 32768, 32768}));
  // What steps of the room before found does not bring it back.
  EXPECT_FALSE(plan.Observe({1000, 65536, 65536}, 65000, 60000));
  EXPECT_FALSE(plan.Observe({1000, 65536, 65536}, 65535, 65535));
  int n = 0;
  while (plan.Halve()) ASSERT_LT(++n, 20);
  EXPECT_EQ(plan.most_rays(), 64);
}

}  // namespace
}  // namespace nrff::device
