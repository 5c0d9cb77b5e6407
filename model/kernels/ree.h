// Rendering equation encoding (REE): outgoing light as the response of anisotropic spherical Gaussians (ASG) on fixed
// axes to the reflected direction.
//
//   G = a · max(axis·o, 0) · exp(−λ (axis_λ·o)² − μ (axis_μ·o)²)                                   [Han23] Eq. 11–13
//   λ = softplus(λ_raw − 1),  μ = softplus(μ_raw − 1),  a has two channels
//
// o is the unit reflected direction. Lobe (i, j) of n_theta × n_phi has θ = π i/(n_theta − 1), φ = 2π j/(n_phi − 1) and
//   axis   = (sin θ cos φ, sin θ sin φ, cos θ)
//   axis_λ = (cos θ cos φ, cos θ sin φ, −sin θ)
//   axis_μ = (−sin φ, cos φ, 0)
// so that poles and φ = 0, 2π repeat; each repeat keeps its own a, λ, μ, as in the authors' code.
#pragma once

#include <cstdint>
#include <vector>

namespace nrff {

inline constexpr int kLobeAmplitudes = 2;                    // channels of a
inline constexpr int kLobeParameters = kLobeAmplitudes + 2;  // a0, a1, λ_raw, μ_raw
inline constexpr int kMaxLobes = 512;

struct Lobes {
  int n_theta = 0, n_phi = 0;
  // Per lobe, θ-major [n_theta * n_phi].
  std::vector<double> sin_theta, cos_theta, sin_phi, cos_phi;

  int size() const { return n_theta * n_phi; }
};

// Throws std::invalid_argument unless both counts are ≥ 2 and their product ≤ kMaxLobes.
Lobes MakeLobes(int n_theta, int n_phi);

// directions [n, 3] reflected, unit; raw [n, lobes, kLobeParameters]; encoding [n, lobes, kLobeAmplitudes],
// overwritten. Scalar is float (exp and log to 2 ulp) or double.
template <typename Scalar>
void ReeForward(const Lobes& lobes, const Scalar* directions, const Scalar* raw, int64_t n, Scalar* encoding);

// d_directions [n, 3] (as for three independent coordinates) and d_raw are overwritten. Deterministic.
template <typename Scalar>
void ReeBackward(const Lobes& lobes, const Scalar* directions, const Scalar* raw, int64_t n, const Scalar* d_encoding,
                 Scalar* d_directions, Scalar* d_raw);

}  // namespace nrff
