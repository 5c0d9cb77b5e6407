// TileGemm by products of bf16 pairs that are summed in float: on the matrix unit of x86 processors that have one
// (AMX), or by the dot products of AVX-512's bf16 vectors. Part of tile_gemm_cpu.cc.
//
// On the matrix unit every operand is split into two bf16 numbers, x = hi + lo with |x − hi − lo| ≤ 2⁻¹⁸ |x|, and three
// of the four products are summed: Σ hi·hi + hi·lo + lo·hi. A product is off by 2⁻¹⁶ of itself at the most, without a
// bias: near float's rounding of a sum of a few hundred, at a third of the unit's bf16 rate. Vectors multiply bf16 at
// twice the rate of float, so that three products would not pay there. GemmPrecision::kBf16 leaves out lo. Denormal
// numbers count as zero, and what is not finite comes out as NaN or infinity.
#pragma once

#include "model/kernels/tile_gemm.h"

namespace nrff {

enum class Bf16Unit { kNone, kVectors, kMatrix };

// What processor, operating system and compiler have; asks the operating system for the matrix unit's registers.
Bf16Unit AvailableBf16Unit();

// Whether the product is made here: there is a unit for its precision, and it is large enough to be worth the packing.
bool Bf16Pays(const GemmArgs& args);

// A's part of a product (m, k, a, a_row, a_column, precision) made ready; only where Bf16CanPack.
bool Bf16CanPack(const GemmArgs& args);
void Bf16Pack(const GemmArgs& args, AlignedWords& words);

// Of TileGemm or TileGemmTransposed; only where Bf16Pays.
void TileGemmBf16(const GemmArgs& args, bool b_transposed);

}  // namespace nrff
