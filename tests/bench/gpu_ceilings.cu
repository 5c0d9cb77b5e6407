// What a GPU can do at the most of what a training step asks of it: gpu_ceilings OUT.json

#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <fstream>
#include <functional>
#include <map>
#include <string>
#include <vector>

#include "render/kernels/device_runtime.h"
#include "render/kernels/random.h"

namespace nrff::device {
namespace {

constexpr int kRepeats = 20;

struct CopyFloats {
  const float4* from;
  float4* to;
  NRFF_HOST_DEVICE void operator()(int64_t i) const { to[i] = from[i]; }
};

// Reads of 16 bytes at random places.
struct Gather {
  const float4* table;
  uint64_t n;
  float* sums;
  NRFF_HOST_DEVICE void operator()(int64_t i) const {
    float sum = 0;
    for (int k = 0; k < 8; ++k) {
      const float4 x = table[UniformBelow(n, 1, 2, 8 * static_cast<uint64_t>(i) + k)];
      sum += x.x + x.y + x.z + x.w;
    }
    sums[i] = sum;
  }
};

// Additions of 16 bytes at random places.
struct Scatter {
  float* table;
  uint64_t n;
  NRFF_HOST_DEVICE void operator()(int64_t i) const {
    const float x[4] = {1, 2, 3, 4};
    AtomicAdd4(table + 4 * UniformBelow(n, 1, 2, static_cast<uint64_t>(i)), x);
  }
};

// Milliseconds of one piece of work, the best of several.
double Best(const char* what, const std::function<void()>& queue) {
  queue();
  double best = 1e30;
  for (int i = 0; i < kRepeats; ++i) {
    StartProfile();
    queue();
    best = std::min(best, EndProfile().at(what).milliseconds);
  }
  return best;
}

void Measure(const char* path) {
  const Stream stream;
  std::map<std::string, double> results;
  constexpr int64_t kBytes = int64_t{1} << 30;
  const Buffer<float4> from(kBytes / 16), to(kBytes / 16);
  Zero(from.data(), kBytes, stream.get());
  Zero(to.data(), kBytes, stream.get());
  const double copy = Best("copy", [&] {
    ForEach("copy", kBytes / 16, stream.get(), CopyFloats{from.data(), to.data()});
  });
  results["copy_gb_per_second"] = 2 * kBytes / copy * 1e-6;
  // Tables that the second-level cache holds, and that it does not.
  constexpr int64_t kCalls = int64_t{1} << 21;
  for (const int64_t mebibytes : {16, 64, 1024}) {
    const auto n = static_cast<uint64_t>(mebibytes << 16);
    const double gather = Best("gather", [&] {
      ForEach("gather", kCalls, stream.get(), Gather{from.data(), n, reinterpret_cast<float*>(to.data())});
    });
    results["gather_" + std::to_string(mebibytes) + "_mib_reads_per_second"] = 8 * kCalls / gather * 1e3;
    const double scatter = Best("scatter", [&] {
      ForEach("scatter", kCalls, stream.get(), Scatter{reinterpret_cast<float*>(to.data()), n});
    });
    results["atomics_" + std::to_string(mebibytes) + "_mib_adds_per_second"] = kCalls / scatter * 1e3;
  }
  const Matmul matmul(stream.get());
  const auto products = [&](int64_t m, int64_t n, int64_t k) {
    const Buffer<Bf16> a(m * k), b(n * k), c(m * n);
    Zero(a.data(), 2 * m * k, stream.get());
    Zero(b.data(), 2 * n * k, stream.get());
    MatmulArgs<Bf16> args;
    args.m = m;
    args.n = n;
    args.k = k;
    args.a = a.data();
    args.a_row = k;
    args.b = b.data();
    args.b_row = k;
    args.b_transposed = true;
    args.c = c.data();
    args.c_row = n;
    const double time = Best("products", [&] { matmul(args); });
    stream.Synchronize();
    return 2. * m * n * k / time * 1e-9;
  };
  results["bf16_products_8192_8192_8192_tflops"] = products(8192, 8192, 8192);
  results["bf16_products_131072_256_256_tflops"] = products(131072, 256, 256);
  results["bf16_products_131072_256_392_tflops"] = products(131072, 256, 392);
  std::ofstream out(path);
  out << "{";
  const char* separator = "";
  for (const auto& [name, value] : results) {
    out << separator << "\n  \"" << name << "\": " << value;
    separator = ",";
  }
  out << "\n}\n";
  if (!out.flush()) throw DeviceError(std::string("cannot write ") + path);
}

}  // namespace
}  // namespace nrff::device

int main(int argc, char** argv) {
  if (argc != 2) {
    std::fprintf(stderr, "usage: gpu_ceilings OUT.json\n");
    return 2;
  }
  try {
    nrff::device::Measure(argv[1]);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "gpu_ceilings: %s\n", error.what());
    return 5;
  }
  return 0;
}
