// What the directional network is told of directions. NRFF has the rendering equation encoding; the others are what the
// paper compares it with ([Han23] Table 2), and leave everything else of the model as it is.
//
//   kRee   ree.h; the spatial network's share: features of the rows of lobes
//   kIde   integrated directional encoding [Verbin22] Eq. 8 of the reflected direction; share: one number, the raw
//          roughness. For l in kIdeDegrees and m = 0 … l, real and imaginary part of
//            exp(−l(l+1)/2 · ρ) · Y_lm(o),  ρ = softplus(raw − 1)
//          Y_lm orthonormal, without the Condon–Shortley phase
//   kPe    positional encoding [Mildenhall20] Eq. 4 of the ray's direction d: d, then for k < kPeFrequencies sin(2^k d)
//          and cos(2^k d); share: none
//   kNone  no directional network: rgb = sigmoid(diffuse), no tint, no normals
#pragma once

#include <array>
#include <cstdint>

namespace nrff {

enum class DirectionalEncoding { kRee, kIde, kPe, kNone };

inline constexpr std::array kIdeDegrees = {1, 2, 4, 8, 16};
inline constexpr int kIdeFeatures = 72;
inline constexpr int kPeFrequencies = 4;
inline constexpr int kPeFeatures = 3 + 6 * kPeFrequencies;

// q_l^m of one order m, with Y_lm = q_l^m(z) · (x + iy)^m on the unit sphere: from the one before, for l = m, m+1, …
//   q_m^m = start,  q_l^m = z · up[l] · q_{l−1}^m − back[l] · q_{l−2}^m,  dq_l^m/dz = slope[l] · q_l^{m+1}
struct HarmonicRecurrence {
  double start = 0;
  std::array<double, kIdeDegrees.back() + 1> up{}, back{}, slope{};
};
HarmonicRecurrence MakeHarmonicRecurrence(int m);

// Rows of n values `stride` apart, n a multiple of 16. o: the reflected direction, 3 rows; raw 1 row; encoding
// kIdeFeatures rows, overwritten.
void IdeForwardRows(const float* o, const float* raw, int64_t n, int64_t stride, float* encoding);
// d_o [3 rows] (as for three independent coordinates) and d_raw are overwritten.
void IdeBackwardRows(const float* o, const float* raw, const float* d_encoding, int64_t n, int64_t stride, float* d_o,
                     float* d_raw);

// direction 3 rows, encoding kPeFeatures rows, overwritten.
void PeForwardRows(const float* direction, int64_t n, int64_t stride, float* encoding);

}  // namespace nrff
