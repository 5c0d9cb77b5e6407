#include "model/kernels/tile_gemm_bf16.h"

#include <algorithm>
#include <stdexcept>

#include "model/kernels/simd.h"

#if defined(NRFF_CPU_LEVELS) && defined(__linux__) && __GNUC__ >= 12
#define NRFF_BF16_UNITS
#include <cpuid.h>
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"  // of GCC 12's own header, wherever it is inlined
#include <immintrin.h>
#include <sys/syscall.h>
#include <unistd.h>
#endif

namespace nrff {

#ifdef NRFF_BF16_UNITS

namespace {

#define NRFF_BF16_TARGET __attribute__((target("arch=x86-64-v4,avx512bf16,amx-tile,amx-bf16,prefer-vector-width=512")))
#define NRFF_BF16_INLINE NRFF_BF16_TARGET NRFF_INLINE

// A register tile has 16 rows of 16 pairs of bf16 (operands) or of 16 floats (sums). Blocks of C are 2 × 2 of them.
constexpr int64_t kTileRows = 16, kTileDepth = 32, kBlock = 32;
constexpr int64_t kTileWords = 256;  // 32-bit
constexpr int64_t kDepth = 512;      // inner products are cut to this, so that a panel of B stays near

int64_t RoundUp(int64_t n, int64_t multiple) { return (n + multiple - 1) / multiple * multiple; }

struct alignas(64) TileConfig {
  uint8_t palette = 1, start_row = 0, reserved[14] = {};
  uint16_t column_bytes[16] = {};
  uint8_t rows[16] = {};
};

// Lane l is the pair (first[l], second[l]), rounded.
NRFF_BF16_INLINE __m512i RoundPairs(__m512 first, __m512 second) {
  alignas(64) static constexpr uint16_t kInterleave[32] = {0,  16, 1,  17, 2,  18, 3,  19, 4,  20, 5,
                                                           21, 6,  22, 7,  23, 8,  24, 9,  25, 10, 26,
                                                           11, 27, 12, 28, 13, 29, 14, 30, 15, 31};
  return _mm512_permutexvar_epi16(_mm512_load_si512(kInterleave), (__m512i)_mm512_cvtne2ps_pbh(second, first));
}

// Rows of 16 words → columns.
NRFF_BF16_INLINE void Transpose(__m512i rows[16]) {
  __m512i t[16];
  for (int i = 0; i < 8; ++i) {
    t[2 * i] = _mm512_unpacklo_epi32(rows[2 * i], rows[2 * i + 1]);
    t[2 * i + 1] = _mm512_unpackhi_epi32(rows[2 * i], rows[2 * i + 1]);
  }
  for (int i = 0; i < 4; ++i) {
    rows[4 * i] = _mm512_unpacklo_epi64(t[4 * i], t[4 * i + 2]);
    rows[4 * i + 1] = _mm512_unpackhi_epi64(t[4 * i], t[4 * i + 2]);
    rows[4 * i + 2] = _mm512_unpacklo_epi64(t[4 * i + 1], t[4 * i + 3]);
    rows[4 * i + 3] = _mm512_unpackhi_epi64(t[4 * i + 1], t[4 * i + 3]);
  }
  for (int i = 0; i < 4; ++i) {
    t[i] = _mm512_shuffle_i32x4(rows[i], rows[4 + i], 0x88);
    t[4 + i] = _mm512_shuffle_i32x4(rows[i], rows[4 + i], 0xdd);
    t[8 + i] = _mm512_shuffle_i32x4(rows[8 + i], rows[12 + i], 0x88);
    t[12 + i] = _mm512_shuffle_i32x4(rows[8 + i], rows[12 + i], 0xdd);
  }
  for (int i = 0; i < 8; ++i) {
    rows[i] = _mm512_shuffle_i32x4(t[i], t[8 + i], 0x88);
    rows[8 + i] = _mm512_shuffle_i32x4(t[i], t[8 + i], 0xdd);
  }
}

// The pairs as a row of a tile, and below it of the tile of what rounding left.
template <GemmPrecision kPrecision>
NRFF_BF16_INLINE void StorePairs(__m512 first, __m512 second, uint32_t* to) {
  const __m512i hi = RoundPairs(first, second);
  _mm512_store_si512(to, hi);
  if constexpr (kPrecision == GemmPrecision::kFloat) {
    const __m512 hi_first = _mm512_castsi512_ps(_mm512_slli_epi32(hi, 16));
    const __m512 hi_second = _mm512_castsi512_ps(_mm512_and_si512(hi, _mm512_set1_epi32(int(0xFFFF0000U))));
    _mm512_store_si512(to + kTileWords, RoundPairs(first - hi_first, second - hi_second));
  }
}

// 32 neighbouring numbers from x on, zero from end on, as 16 pairs.
NRFF_BF16_INLINE void StoreRow(const float* x, const float* end, uint32_t* to) {
  const __m512i even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
  const __m512i odd = _mm512_add_epi32(even, _mm512_set1_epi32(1));
  const auto n = uint32_t(std::min<int64_t>(kTileDepth, end - x));
  const uint32_t lanes = n == kTileDepth ? ~0U : (1U << n) - 1;
  const __m512 left = _mm512_maskz_loadu_ps(__mmask16(lanes), x);
  const __m512 right = _mm512_maskz_loadu_ps(__mmask16(lanes >> 16), x + 16);
  StorePairs<GemmPrecision::kFloat>(_mm512_permutex2var_ps(left, even, right), _mm512_permutex2var_ps(left, odd, right),
                                    to);
}

// The tile of columns k to k + 31 of 16 rows of a matrix, zero from row n_rows and column k_end on; hi, then lo.
NRFF_BF16_INLINE void PackRows(const float* matrix, int64_t row_length, int64_t n_rows, int64_t k, int64_t k_end,
                               uint32_t* to) {
  for (int64_t r = 0; r < kTileRows; ++r) {
    const float* row = matrix + r * row_length;
    if (r < n_rows) {
      StoreRow(row + k, row + k_end, to + 16 * r);
    } else {
      StorePairs<GemmPrecision::kFloat>(_mm512_setzero_ps(), _mm512_setzero_ps(), to + 16 * r);
    }
  }
}

// The tile of rows k to k + 31 of 16 columns, in pairs of rows; zero from row k_end and column n_columns on.
template <GemmPrecision kPrecision>
NRFF_BF16_INLINE void PackColumns(const float* matrix, int64_t row_length, int64_t n_columns, int64_t k, int64_t k_end,
                                  uint32_t* to) {
  const auto lanes = __mmask16(n_columns >= 16 ? ~0U : (1U << n_columns) - 1);
  for (int64_t pair = 0; pair < 16; ++pair) {
    const int64_t at = k + 2 * pair;
    const float* row = matrix + at * row_length;
    const __m512 x = at < k_end ? _mm512_maskz_loadu_ps(lanes, row) : _mm512_setzero_ps();
    const __m512 y = at + 1 < k_end ? _mm512_maskz_loadu_ps(lanes, row + row_length) : _mm512_setzero_ps();
    StorePairs<kPrecision>(x, y, to + 16 * pair);
  }
}

// The tile's rows become its columns, hi and lo.
NRFF_BF16_INLINE void TransposeTile(uint32_t* tile) {
  for (int part = 0; part < 2; ++part, tile += kTileWords) {
    __m512i rows[16];
    for (int r = 0; r < 16; ++r) rows[r] = _mm512_load_si512(tile + 16 * r);
    Transpose(rows);
    for (int r = 0; r < 16; ++r) _mm512_store_si512(tile + 16 * r, rows[r]);
  }
}

// Operands are tiles of 16 rows of A by pairs of k, and of 16 pairs of k by columns of B.
NRFF_BF16_INLINE void PackTileOfA(const GemmArgs& args, int64_t i, int64_t k, int64_t k_end, uint32_t* to) {
  if (args.a_column == 1) {
    PackRows(args.a + i * args.a_row, args.a_row, args.m - i, k, k_end, to);
  } else {
    PackColumns<GemmPrecision::kFloat>(args.a + i, args.a_column, args.m - i, k, k_end, to);
    TransposeTile(to);
  }
}

template <GemmPrecision kPrecision>
NRFF_BF16_INLINE void PackTileOfB(const GemmArgs& args, bool transposed, int64_t j, int64_t k, int64_t k_end,
                                  uint32_t* to) {
  if (transposed) {
    PackRows(args.b + j * args.b_row, args.b_row, args.n - j, k, k_end, to);
    TransposeTile(to);
  } else {
    PackColumns<kPrecision>(args.b + j, args.b_row, args.n - j, k, k_end, to);
  }
}

// A block of C whose sums [32][32] are made, but not what becomes of them.
struct PendingBlock {
  GemmStart start = GemmStart::kZero;
  bool last = false;  // no more of k is to come
  int64_t i = 0, j = 0, n_rows = 0;
  const float* sums = nullptr;

  // Rows first to end − 1 of it.
  NRFF_BF16_INLINE void Finish(const GemmArgs& args, int64_t first, int64_t end) const {
    const bool right = j + kTileRows < args.n;
    for (int64_t r = first; r < std::min(end, n_rows); ++r) {
      FinishVector(args, r, 0);
      if (right) FinishVector(args, r, kTileRows);
    }
  }

 private:
  NRFF_BF16_INLINE void FinishVector(const GemmArgs& args, int64_t r, int64_t column) const {
    const int64_t at = (i + r) * args.c_row + j + column;
    float* c = args.c + at;
    __m512 sum = _mm512_load_ps(sums + r * kBlock + column);
    if (start == GemmStart::kSum) sum += _mm512_loadu_ps(c);
    if (start == GemmStart::kBias) sum += _mm512_set1_ps(args.bias[i + r]);
    if (last && args.factor != nullptr) sum *= _mm512_loadu_ps(args.factor + at);
    _mm512_storeu_ps(c, sum);
    if (last && args.activation) {
      ActivateInline(*args.activation, kTileRows, c, args.derivative != nullptr ? args.derivative + at : nullptr);
    }
  }
};

// Where the sums of a block go.
struct BlockSums {
  float *upper, *lower;  // lower: of rows 16 to 31
  int64_t row;           // from one row to the next
  bool add;              // to what is there
};

// The operands of a block, per 32 of k the tile of A's upper 16 rows hi, lo, of the lower hi, lo, and of B's left 16
// columns hi, lo, of the right hi, lo.
struct BlockOperands {
  const uint32_t *a, *b;
  int64_t n_steps, n_rows;
  bool right;  // whether the right columns are used
};
constexpr int64_t kStepWords = 4 * kTileWords;

// beside(s) is called for every 32 of k: work for the vector units, which have little to do while the matrix unit
// multiplies a block for two thousand cycles.
template <GemmPrecision kPrecision, typename Beside>
NRFF_BF16_INLINE void MultiplyOnMatrixUnit(const BlockOperands& operands, const BlockSums& sums, const Beside& beside) {
  constexpr int64_t kRowBytes = 64;
  const int64_t sums_row_bytes = sums.row * int64_t(sizeof(float));
  const bool right = operands.right, lower = operands.n_rows > kTileRows;
  if (sums.add) {
    _tile_loadd(0, sums.upper, sums_row_bytes);
    if (right) _tile_loadd(1, sums.upper + kTileRows, sums_row_bytes);
    if (lower) _tile_loadd(2, sums.lower, sums_row_bytes);
    if (lower && right) _tile_loadd(3, sums.lower + kTileRows, sums_row_bytes);
  } else {
    _tile_zero(0);
    _tile_zero(1);
    _tile_zero(2);
    _tile_zero(3);
  }
  const uint32_t *a = operands.a, *b = operands.b;
  for (int64_t s = 0; s < operands.n_steps; ++s, a += kStepWords, b += kStepWords) {
    const auto all = [&]() NRFF_BF16_TARGET {
      _tile_dpbf16ps(0, 4, 6);
      if (right) _tile_dpbf16ps(1, 4, 7);
      if (lower) _tile_dpbf16ps(2, 5, 6);
      if (lower && right) _tile_dpbf16ps(3, 5, 7);
    };
    _tile_loadd(4, a, kRowBytes);
    _tile_loadd(5, a + 2 * kTileWords, kRowBytes);
    if constexpr (kPrecision == GemmPrecision::kFloat) {
      _tile_loadd(6, b + kTileWords, kRowBytes);
      _tile_loadd(7, b + 3 * kTileWords, kRowBytes);
      all();
    }
    _tile_loadd(6, b, kRowBytes);
    _tile_loadd(7, b + 2 * kTileWords, kRowBytes);
    all();
    if constexpr (kPrecision == GemmPrecision::kFloat) {
      _tile_loadd(4, a + kTileWords, kRowBytes);
      _tile_loadd(5, a + 3 * kTileWords, kRowBytes);
      all();
    }
    beside(s);
  }
  _tile_stored(0, sums.upper, sums_row_bytes);
  if (right) _tile_stored(1, sums.upper + kTileRows, sums_row_bytes);
  if (lower) _tile_stored(2, sums.lower, sums_row_bytes);
  if (lower && right) _tile_stored(3, sums.lower + kTileRows, sums_row_bytes);
}

// kGroup rows of a block from `first` on, with the sums in registers.
template <int kVectors>
NRFF_BF16_INLINE void MultiplyRowsInVectors(const BlockOperands& operands, const BlockSums& sums, int64_t first) {
  constexpr int kGroup = 8;
  float* c = first < kTileRows ? sums.upper + first * sums.row : sums.lower + (first - kTileRows) * sums.row;
  __m512 sum[kGroup][kVectors];
#pragma GCC unroll 8
  for (int r = 0; r < kGroup; ++r) {
#pragma GCC unroll 2
    for (int v = 0; v < kVectors; ++v) {
      sum[r][v] = sums.add ? _mm512_loadu_ps(c + r * sums.row + 16 * v) : _mm512_setzero_ps();
    }
  }
  const uint32_t *a = operands.a + first / kTileRows * 2 * kTileWords + first % kTileRows * 16, *b = operands.b;
  for (int64_t s = 0; s < operands.n_steps; ++s, a += kStepWords, b += kStepWords) {
    for (int64_t pair = 0; pair < 16; ++pair) {
      __m512i b_pair[kVectors];
#pragma GCC unroll 2
      for (int v = 0; v < kVectors; ++v) b_pair[v] = _mm512_load_si512(b + 16 * pair + v * 2 * kTileWords);
#pragma GCC unroll 8
      for (int r = 0; r < kGroup; ++r) {
        const __m512i a_pair = _mm512_set1_epi32(int(a[16 * r + pair]));
#pragma GCC unroll 2
        for (int v = 0; v < kVectors; ++v) {
          sum[r][v] = _mm512_dpbf16_ps(sum[r][v], (__m512bh)a_pair, (__m512bh)b_pair[v]);
        }
      }
    }
  }
#pragma GCC unroll 8
  for (int r = 0; r < kGroup; ++r) {
#pragma GCC unroll 2
    for (int v = 0; v < kVectors; ++v) _mm512_storeu_ps(c + r * sums.row + 16 * v, sum[r][v]);
  }
}

template <Bf16Unit kUnit, GemmPrecision kPrecision, typename Beside>
NRFF_BF16_INLINE void MultiplyBlock(const BlockOperands& operands, const BlockSums& sums, const Beside& beside) {
  if constexpr (kUnit == Bf16Unit::kMatrix) {
    MultiplyOnMatrixUnit<kPrecision>(operands, sums, beside);
  } else {
    static_assert(kPrecision == GemmPrecision::kBf16);
    for (int64_t first = 0; first < operands.n_rows; first += 8) {
      if (operands.right) {
        MultiplyRowsInVectors<2>(operands, sums, first);
      } else {
        MultiplyRowsInVectors<1>(operands, sums, first);
      }
    }
    for (int64_t s = 0; s < operands.n_steps; ++s) beside(s);
  }
}

int64_t StepsOf(int64_t depth) { return RoundUp(depth, kTileDepth) / kTileDepth; }

// Rows of A in blocks of 32: a panel of tiles each.
NRFF_BF16_TARGET uint32_t* PackA(const GemmArgs& args, int64_t k_begin, int64_t k_end, AlignedWords& words) {
  const int64_t n_steps = StepsOf(k_end - k_begin), panel = n_steps * kStepWords;
  uint32_t* a = words.Reserve(RoundUp(args.m, kBlock) / kBlock * panel);
  for (int64_t i = 0; i < args.m; i += kTileRows) {
    uint32_t* to = a + i / kBlock * panel + i % kBlock / kTileRows * 2 * kTileWords;
    for (int64_t s = 0; s < n_steps; ++s) {
      PackTileOfA(args, i, k_begin + s * kTileDepth, k_end, to + s * kStepWords);
    }
  }
  return a;
}

template <Bf16Unit kUnit, GemmPrecision kPrecision>
NRFF_BF16_TARGET void Multiply(const GemmArgs& args, bool b_transposed) {
  thread_local AlignedWords words_of_a, words_of_b;
  if constexpr (kUnit == Bf16Unit::kMatrix) {
    TileConfig config;
    for (int t = 0; t < 8; ++t) {
      config.column_bytes[t] = 64;
      config.rows[t] = kTileRows;
    }
    _tile_loadconfig(&config);
  }
  alignas(64) float sums[2][kBlock * kBlock];
  int which = 0;  // of them is written next
  PendingBlock pending;
  const uint32_t* packed = args.packed_a != nullptr ? args.packed_a->words() : nullptr;
  const int64_t n_blocks = RoundUp(args.m, kBlock) / kBlock;
  for (int64_t k_begin = 0; k_begin < args.k; k_begin += kDepth) {
    const int64_t k_end = std::min(args.k, k_begin + kDepth);
    const GemmStart start = k_begin == 0 ? args.start : GemmStart::kSum;
    const bool last = k_end == args.k;
    const bool sums_alone = start != GemmStart::kBias && !(last && (args.activation || args.factor != nullptr));
    const int64_t n_steps = StepsOf(k_end - k_begin), panel = n_steps * kStepWords;
    const int64_t rows_per_step = (kBlock + n_steps - 1) / n_steps;
    const uint32_t* a = packed != nullptr ? packed : PackA(args, k_begin, k_end, words_of_a);
    uint32_t* b = words_of_b.Reserve(2 * panel);
    uint32_t* next_b = b + panel;
    const auto pack_b = [&](int64_t j, int64_t s, int64_t half, uint32_t* to) NRFF_BF16_TARGET {
      if (j + half * kTileRows >= args.n) return;
      PackTileOfB<kPrecision>(args, b_transposed, j + half * kTileRows, k_begin + s * kTileDepth, k_end,
                              to + s * kStepWords + 2 * half * kTileWords);
    };
    for (int64_t s = 0; s < n_steps; ++s) {
      for (int64_t half = 0; half < 2; ++half) pack_b(0, s, half, b);
    }
    pending.Finish(args, 0, kBlock);  // of the cut of k before: blocks go on from what it writes
    pending.n_rows = 0;
    for (int64_t j = 0; j < args.n; j += kBlock, std::swap(b, next_b)) {
      // Tiles beyond m and n are loaded, but not used.
      for (int64_t block = 0; block < n_blocks; ++block) {
        const int64_t i = block * kBlock, n_rows = std::min(kBlock, args.m - i);
        const bool direct = sums_alone && n_rows % kTileRows == 0;
        float *own = sums[which], *c = args.c + i * args.c_row + j;
        const BlockSums to = direct ? BlockSums{c, c + kTileRows * args.c_row, args.c_row, start == GemmStart::kSum}
                                    : BlockSums{own, own + kTileRows * kBlock, kBlock, false};
        MultiplyBlock<kUnit, kPrecision>({a + block * panel, b, n_steps, n_rows, j + kTileRows < args.n}, to,
                                         [&](int64_t s) NRFF_BF16_TARGET {
                                           pending.Finish(args, s * rows_per_step, (s + 1) * rows_per_step);
                                           if (block == 0) pack_b(j + kBlock, s, 0, next_b);
                                           if (block == n_blocks / 2) pack_b(j + kBlock, s, 1, next_b);
                                         });
        pending.n_rows = 0;
        if (direct) continue;
        pending = {start, last, i, j, n_rows, own};
        which = 1 - which;
      }
    }
  }
  pending.Finish(args, 0, kBlock);
  if constexpr (kUnit == Bf16Unit::kMatrix) _tile_release();
}

}  // namespace

#pragma GCC diagnostic pop

Bf16Unit AvailableBf16Unit() {
  static const Bf16Unit kUnit = [] {
    unsigned a = 0, b = 0, c = 0, d = 0;
    constexpr unsigned kAvx512Bf16 = 1U << 5, kAmxBf16 = 1U << 22, kAmxTile = 1U << 24;
    if (!__builtin_cpu_supports("x86-64-v4") || __get_cpuid_count(7, 1, &a, &b, &c, &d) == 0 ||
        (a & kAvx512Bf16) == 0) {
      return Bf16Unit::kNone;
    }
    if (__get_cpuid_count(7, 0, &a, &b, &c, &d) == 0 || (d & kAmxBf16) == 0 || (d & kAmxTile) == 0) {
      return Bf16Unit::kVectors;
    }
    constexpr long kArchReqXcompPerm = 0x1023, kXfeatureTileData = 18;  // asm/prctl.h, Documentation/arch/x86/xstate
    return syscall(SYS_arch_prctl, kArchReqXcompPerm, kXfeatureTileData) == 0 ? Bf16Unit::kMatrix : Bf16Unit::kVectors;
  }();
  return kUnit;
}

bool Bf16CanPack(const GemmArgs& args) { return Bf16Pays(args) && args.k <= kDepth; }
void Bf16Pack(const GemmArgs& args, AlignedWords& words) { PackA(args, 0, args.k, words); }
void TileGemmBf16(const GemmArgs& args, bool b_transposed) {
  if (AvailableBf16Unit() == Bf16Unit::kVectors) {
    Multiply<Bf16Unit::kVectors, GemmPrecision::kBf16>(args, b_transposed);
  } else if (args.precision == GemmPrecision::kBf16) {
    Multiply<Bf16Unit::kMatrix, GemmPrecision::kBf16>(args, b_transposed);
  } else {
    Multiply<Bf16Unit::kMatrix, GemmPrecision::kFloat>(args, b_transposed);
  }
}

#else

Bf16Unit AvailableBf16Unit() { return Bf16Unit::kNone; }
bool Bf16CanPack(const GemmArgs&) { return false; }
void Bf16Pack(const GemmArgs&, AlignedWords&) { throw std::logic_error("this build has no bf16 products"); }
void TileGemmBf16(const GemmArgs&, bool) { throw std::logic_error("this build has no bf16 products"); }

#endif

bool Bf16Pays(const GemmArgs& args) {
  const Bf16Unit unit = AvailableBf16Unit();
  if (unit == Bf16Unit::kNone || (unit == Bf16Unit::kVectors && args.precision == GemmPrecision::kFloat)) return false;
  constexpr int64_t kFewest = 16;
  return args.m >= kFewest && args.k >= kFewest && (args.a_column == 1 || args.a_row == 1);
}

}  // namespace nrff
