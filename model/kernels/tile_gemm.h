// Matrix products of the networks' tiles (shading_tile.h): small, in cache, one thread.
#pragma once

#include <cstdint>
#include <memory>
#include <optional>

#include "model/kernels/activation.h"

namespace nrff {

// Columns of C and B are worked on in groups of so many.
inline constexpr int64_t kGemmColumns = 16;

enum class GemmStart { kZero, kBias, kSum };

// kBf16: where the processor multiplies bf16 (8 bits, |error| ≤ 2⁻⁹ |x|), A and B may be rounded to it and their
// products summed in float, in a third to half of the time; elsewhere the same as kFloat.
enum class GemmPrecision { kFloat, kBf16 };

// 32-bit words that grow and start at a cache line; what was in them is lost.
class AlignedWords {
 public:
  uint32_t* Reserve(int64_t n);
  const uint32_t* data() const { return words_.get(); }

 private:
  struct Free {
    void operator()(uint32_t* words) const;
  };
  std::unique_ptr<uint32_t, Free> words_;
  int64_t n_ = 0;
};

class PackedOperand;

// C[i][j] = start + Σ_k A(i, k) B[k][j], for i < m, j < n.
// start: 0, bias[i], or C[i][j] as it was. n is a multiple of kGemmColumns. With an activation C is that of the sum.
struct GemmArgs {
  int64_t m = 0, n = 0, k = 0;
  const float* a = nullptr;  // A(i, k) = a[i · a_row + k · a_column]
  int64_t a_row = 0, a_column = 0;
  const PackedOperand* packed_a = nullptr;  // of a, or null
  const float* b = nullptr;                 // B[k][j] = b[k · b_row + j]
  int64_t b_row = 0;
  float* c = nullptr;  // C[i][j] = c[i · c_row + j]; overlaps neither a nor b
  int64_t c_row = 0;
  GemmStart start = GemmStart::kZero;
  const float* bias = nullptr;
  std::optional<Activation> activation = {};
  float* derivative = nullptr;    // of the activation, rows as C's; or null
  const float* factor = nullptr;  // C is the sum times it, rows as C's; or null. Not with an activation
  GemmPrecision precision = GemmPrecision::kFloat;
};
void TileGemm(const GemmArgs& args);

// A of many products, made ready for them once. Empty where that saves nothing.
class PackedOperand {
 public:
  // What is read of the products: m, k, a, a_row, a_column, precision.
  void Pack(const GemmArgs& args);
  const uint32_t* words() const { return packed_ ? words_.data() : nullptr; }

 private:
  AlignedWords words_;
  bool packed_ = false;
};

// The same with B(k, j) = b[j · b_row + k], in float, without an activation or a factor. scratch: the product's use, [k
// rounded up to 4][scratch_row], with scratch_row ≥ n.
struct GemmScratch {
  float* values = nullptr;
  int64_t row = 0;
};
void TileGemmTransposed(const GemmArgs& args, const GemmScratch& scratch);

// to[j][i] = from[i][j] for i < rows, j < columns, multiples of 4.
void TileTranspose(const float* from, int64_t from_row, int64_t rows, int64_t columns, float* to, int64_t to_row);

}  // namespace nrff
