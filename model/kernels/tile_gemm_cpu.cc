#include <algorithm>
#include <cstring>
#include <new>

#include "model/kernels/simd.h"
#include "model/kernels/tile_gemm.h"
#include "model/kernels/tile_gemm_bf16.h"

namespace nrff {
namespace {

template <int kLanes>
struct Vector {
  typedef float Type __attribute__((vector_size(kLanes * sizeof(float))));
};

// Inner products are cut so that the panel of B that a block of columns reads stays in the first-level cache.
constexpr int64_t kDepth = 160;

// kRows x (kVectors · kLanes) of C, in registers: every element of B that is loaded is used kRows times, every one of A
// kVectors times.
template <int kLanes, int kRows, int kVectors>
NRFF_INLINE void Block(const GemmArgs& args, int64_t i, int64_t j, int64_t k_begin, int64_t k_end) {
  using V = typename Vector<kLanes>::Type;
  V sum[kRows][kVectors] = {};
  const GemmStart start = k_begin == 0 ? args.start : GemmStart::kSum;
  if (start == GemmStart::kSum) {
    for (int r = 0; r < kRows; ++r) {
      for (int v = 0; v < kVectors; ++v) {
        std::memcpy(&sum[r][v], args.c + (i + r) * args.c_row + j + v * kLanes, sizeof(V));
      }
    }
  } else {
    for (int r = 0; r < kRows; ++r) {
      const float bias = start == GemmStart::kBias ? args.bias[i + r] : 0.F;
      for (int v = 0; v < kVectors; ++v) sum[r][v] = bias - V{};
    }
  }
  const float* b = args.b + k_begin * args.b_row + j;
  const float* a = args.a + i * args.a_row + k_begin * args.a_column;
  for (int64_t k = k_begin; k < k_end; ++k, b += args.b_row, a += args.a_column) {
    V b_row[kVectors];
    for (int v = 0; v < kVectors; ++v) std::memcpy(&b_row[v], b + v * kLanes, sizeof(V));
    for (int r = 0; r < kRows; ++r) {
      const V a_all = a[r * args.a_row] - V{};  // x − 0 is x, so this is a broadcast alone
      for (int v = 0; v < kVectors; ++v) sum[r][v] += a_all * b_row[v];
    }
  }
  for (int r = 0; r < kRows; ++r) {
    for (int v = 0; v < kVectors; ++v) {
      std::memcpy(args.c + (i + r) * args.c_row + j + v * kLanes, &sum[r][v], sizeof(V));
    }
  }
}

template <int kLanes, int kRows, int kVectors>
NRFF_INLINE void Columns(const GemmArgs& args, int64_t j, int64_t k_begin, int64_t k_end) {
  int64_t i = 0;
  for (; i + kRows <= args.m; i += kRows) Block<kLanes, kRows, kVectors>(args, i, j, k_begin, k_end);
  if constexpr (kRows > 3) {
    if (i + 3 <= args.m) {
      Block<kLanes, 3, kVectors>(args, i, j, k_begin, k_end);
      i += 3;
    }
  }
  for (; i < args.m; ++i) Block<kLanes, 1, kVectors>(args, i, j, k_begin, k_end);
}

template <int kLanes, int kRows, int kVectors>
NRFF_INLINE void Gemm(const GemmArgs& args) {
  int64_t k_begin = 0;
  do {
    const int64_t k_end = std::min(args.k, k_begin + kDepth);
    int64_t j = 0;
    for (; j + kVectors * kLanes <= args.n; j += kVectors * kLanes) {
      Columns<kLanes, kRows, kVectors>(args, j, k_begin, k_end);
    }
    if constexpr (kVectors * kLanes > 2 * kGemmColumns) {
      for (; j + 2 * kGemmColumns <= args.n; j += 2 * kGemmColumns) {
        Columns<kLanes, kRows, int(2 * kGemmColumns) / kLanes>(args, j, k_begin, k_end);
      }
    }
    for (; j < args.n; j += kGemmColumns) Columns<kLanes, kRows, int(kGemmColumns) / kLanes>(args, j, k_begin, k_end);
    k_begin = k_end;
  } while (k_begin < args.k);
}

#ifdef NRFF_CPU_LEVELS
__attribute__((target("arch=x86-64-v4,prefer-vector-width=512"))) void GemmOfLevel4(const GemmArgs& args) {
  Gemm<16, 6, 4>(args);
}
__attribute__((target("arch=x86-64-v3"))) void GemmOfLevel3(const GemmArgs& args) { Gemm<8, 6, 2>(args); }
#endif
void GemmOfAnyCpu(const GemmArgs& args) { Gemm<4, 2, 4>(args); }

NRFF_MULTIVERSION void ScaleRow(const float* factor, int64_t n, float* row) {
#pragma GCC ivdep
  for (int64_t j = 0; j < n; ++j) row[j] *= factor[j];
}

}  // namespace

uint32_t* AlignedWords::Reserve(int64_t n) {
  if (n > n_) {
    words_.reset(static_cast<uint32_t*>(::operator new (n * sizeof(uint32_t), std::align_val_t{64})));
    n_ = n;
  }
  return words_.get();
}

void AlignedWords::Free::operator()(uint32_t* words) const { ::operator delete (words, std::align_val_t{64}); }

void PackedOperand::Pack(const GemmArgs& args) {
  packed_ = Bf16CanPack(args);
  if (packed_) Bf16Pack(args, words_);
}

void TileGemm(const GemmArgs& args) {
  if (args.m == 0 || args.n == 0) return;
  if (Bf16Pays(args)) {
    TileGemmBf16(args, /*b_transposed=*/false);
    return;
  }
#ifdef NRFF_CPU_LEVELS
  static const auto kGemm = __builtin_cpu_supports("x86-64-v4")   ? GemmOfLevel4
                            : __builtin_cpu_supports("x86-64-v3") ? GemmOfLevel3
                                                                  : GemmOfAnyCpu;
  kGemm(args);
#else
  GemmOfAnyCpu(args);
#endif
  for (int64_t i = 0; args.factor != nullptr && i < args.m; ++i) {
    ScaleRow(args.factor + i * args.c_row, args.n, args.c + i * args.c_row);
  }
  for (int64_t i = 0; args.activation && i < args.m; ++i) {
    float* derivative = args.derivative != nullptr ? args.derivative + i * args.c_row : nullptr;
    ActivateRow(*args.activation, args.n, args.c + i * args.c_row, derivative);
  }
}

void TileGemmTransposed(const GemmArgs& args, const GemmScratch& scratch) {
  if (Bf16Pays(args)) {
    TileGemmBf16(args, /*b_transposed=*/true);
    return;
  }
  TileTranspose(args.b, args.b_row, args.n, args.k, scratch.values, scratch.row);
  GemmArgs across = args;
  across.b = scratch.values;
  across.b_row = scratch.row;
  TileGemm(across);
}

void TileTranspose(const float* from, int64_t from_row, int64_t rows, int64_t columns, float* to, int64_t to_row) {
  typedef float V __attribute__((vector_size(16)));
  for (int64_t i = 0; i < rows; i += 4) {
    for (int64_t j = 0; j < columns; j += 4) {
      V a[4];
      for (int r = 0; r < 4; ++r) std::memcpy(&a[r], from + (i + r) * from_row + j, sizeof(V));
      const V low01 = __builtin_shufflevector(a[0], a[1], 0, 4, 1, 5);
      const V low23 = __builtin_shufflevector(a[2], a[3], 0, 4, 1, 5);
      const V high01 = __builtin_shufflevector(a[0], a[1], 2, 6, 3, 7);
      const V high23 = __builtin_shufflevector(a[2], a[3], 2, 6, 3, 7);
      const V columns_of[4] = {
          __builtin_shufflevector(low01, low23, 0, 1, 4, 5), __builtin_shufflevector(low01, low23, 2, 3, 6, 7),
          __builtin_shufflevector(high01, high23, 0, 1, 4, 5), __builtin_shufflevector(high01, high23, 2, 3, 6, 7)};
      for (int r = 0; r < 4; ++r) std::memcpy(to + (j + r) * to_row + i, &columns_of[r], sizeof(V));
    }
  }
}

}  // namespace nrff
