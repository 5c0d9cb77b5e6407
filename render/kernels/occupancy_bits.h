// The occupancy grid as kernels see it: one bit per cell of a cube of resolution³ cells over field coordinates
// [-1, 1]³, stored in blocks of 8³ cells (512 bits, one cache line), and one byte per block that says whether any of
// its cells is occupied.
#pragma once

#include <cstddef>
#include <cstdint>

#include "render/kernels/device.h"

namespace nrff {

inline constexpr int kOccupancyBlock = 8;  // cells per axis of a block; 8 words of 64 bits

struct OccupancyBits {
  int resolution = 0;               // cells per axis, a multiple of 8
  const uint64_t* cells = nullptr;  // [n_blocks · 8] word z%8 of the block, bit (y%8)·8 + x%8
  const uint8_t* blocks = nullptr;  // [n_blocks] 0: empty; blocks are ordered z-major, then y, then x

  NRFF_HOST_DEVICE int BlocksPerAxis() const { return resolution / kOccupancyBlock; }
  NRFF_HOST_DEVICE size_t BlockOf(int x, int y, int z) const {
    const auto n = static_cast<size_t>(BlocksPerAxis());
    return ((static_cast<size_t>(z) >> 3) * n + (static_cast<size_t>(y) >> 3)) * n + (static_cast<size_t>(x) >> 3);
  }
  NRFF_HOST_DEVICE bool CellOccupied(size_t block, int x, int y, int z) const {
    return (cells[block * 8 + (z & 7)] >> (((y & 7) << 3) | (x & 7))) & 1;
  }
};

}  // namespace nrff
