// TileGemm on the matrix unit of x86 processors that have one (AMX, bf16). Part of tile_gemm_cpu.cc.
//
// Every operand is split into two bf16 numbers, x = hi + lo with |x − hi − lo| ≤ 2⁻¹⁸ |x|, and three of the four
// products are summed in float: Σ hi·hi + hi·lo + lo·hi. A product is off by 2⁻¹⁶ of itself at the most, without a
// bias: near float's rounding of a sum of a few hundred, at a third of the unit's bf16 rate. Denormal numbers count
// as zero, and what is not finite comes out as NaN or infinity. GemmPrecision::kBf16 leaves out lo.
#pragma once

#include "model/kernels/tile_gemm.h"

namespace nrff {

// Whether processor, operating system and compiler have it; asks the operating system for its registers.
bool AmxAvailable();

// Products smaller than this are not worth the packing.
bool AmxPays(const GemmArgs& args);

// A's part of a product (m, k, a, a_row, a_column) made ready. AmxCanPack: whether that can be used.
bool AmxCanPack(const GemmArgs& args);
void AmxPack(const GemmArgs& args, AlignedWords& words);

// Of TileGemm or TileGemmTransposed.
void TileGemmAmx(const GemmArgs& args, bool b_transposed);

}  // namespace nrff
