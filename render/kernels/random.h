// Counter-based random numbers: a pure function of (seed, stream, counter), so that a run can be repeated, resumed and
// split over any number of threads without changing a number.
//
// The hash is three rounds of the splitmix64 finaliser [Steele14], which passes BigCrush on counters. Streams are
// named: StreamAt(RandomStream::kRayJitter, step) is independent of every other purpose and step.
#pragma once

#include <cstdint>

#include "render/kernels/device.h"

namespace nrff {

// What random numbers are drawn for. Values are part of what makes a run repeatable: never renumber.
enum class RandomStream : uint64_t {
  kRayJitter = 1,        // counter: ray of the batch
  kOccupancyCells = 2,   // counter: draw
  kOccupancyJitter = 3,  // counter: 3·draw + axis
  kBatch = 4,            // counter: draw
  kInitialisation = 5,
  kBackground = 6,
  kDepthBatch = 7,    // counter: draw
  kDepthJitter = 8,   // counter: ray of the batch
  kCameraPixels = 9,  // counter: draw
};

// The finaliser of splitmix64: a bijection of 64-bit words in which every input bit moves every output bit.
NRFF_HOST_DEVICE inline uint64_t MixBits(uint64_t x) {
  x += 0x9e3779b97f4a7c15ULL;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ULL;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebULL;
  return x ^ (x >> 31);
}

NRFF_HOST_DEVICE inline uint64_t StreamAt(RandomStream purpose, uint64_t step) {
  return MixBits(static_cast<uint64_t>(purpose)) ^ MixBits(step);
}

// 64 random bits.
NRFF_HOST_DEVICE inline uint64_t RandomBits(uint64_t seed, uint64_t stream, uint64_t counter) {
  return MixBits(MixBits(MixBits(seed) + stream) + counter);
}

// Uniform in [0, 1): a multiple of 2⁻²⁴, so exact in float and double alike.
NRFF_HOST_DEVICE inline float Uniform(uint64_t seed, uint64_t stream, uint64_t counter) {
  return static_cast<float>(RandomBits(seed, stream, counter) >> 40) * 0x1p-24F;
}

// Uniform in {0, …, n − 1}; the bias is below n/2⁶⁴.
NRFF_HOST_DEVICE inline uint64_t UniformBelow(uint64_t n, uint64_t seed, uint64_t stream, uint64_t counter) {
  return static_cast<uint64_t>((static_cast<unsigned __int128>(RandomBits(seed, stream, counter)) * n) >> 64);
}

}  // namespace nrff
