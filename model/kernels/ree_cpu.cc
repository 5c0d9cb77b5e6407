#include <algorithm>
#include <cmath>
#include <numbers>
#include <stdexcept>

#include "model/kernels/ree.h"
#include "model/kernels/ree_lobe.h"

namespace nrff {

Lobes MakeLobes(int n_theta, int n_phi) {
  if (n_theta < 2 || n_phi < 2 || n_theta > kMaxLobes / n_phi) {
    throw std::invalid_argument("lobes: need at least 2 x 2 and at most 512 of them");
  }
  Lobes lobes;
  lobes.n_theta = n_theta;
  lobes.n_phi = n_phi;
  for (int i = 0; i < n_theta; ++i) {
    for (int j = 0; j < n_phi; ++j) {
      const double theta = std::numbers::pi * i / (n_theta - 1);
      const double phi = 2 * std::numbers::pi * j / (n_phi - 1);
      lobes.sin_theta.push_back(std::sin(theta));
      lobes.cos_theta.push_back(std::cos(theta));
      lobes.sin_phi.push_back(std::sin(phi));
      lobes.cos_phi.push_back(std::cos(phi));
    }
  }
  return lobes;
}

namespace {

// The lobes in the scalar type of the work.
template <typename Scalar>
struct Angles {
  int n;
  Scalar sin_theta[kMaxLobes], cos_theta[kMaxLobes], sin_phi[kMaxLobes], cos_phi[kMaxLobes];

  explicit Angles(const Lobes& lobes) : n(lobes.size()) {
    for (int k = 0; k < n; ++k) {
      sin_theta[k] = Scalar(lobes.sin_theta[k]);
      cos_theta[k] = Scalar(lobes.cos_theta[k]);
      sin_phi[k] = Scalar(lobes.sin_phi[k]);
      cos_phi[k] = Scalar(lobes.cos_phi[k]);
    }
  }
  NRFF_INLINE Lobe<Scalar> At(int k) const { return {sin_theta[k], cos_theta[k], sin_phi[k], cos_phi[k]}; }
};

template <typename Scalar>
NRFF_INLINE void Forward(const Angles<Scalar>& angles, const Scalar* directions, const Scalar* raw, int64_t begin,
                         int64_t end, Scalar* encoding) {
  for (int64_t i = begin; i < end; ++i) {
    const Scalar* lobe = raw + i * angles.n * kLobeParameters;
    const Scalar o[3] = {directions[3 * i], directions[3 * i + 1], directions[3 * i + 2]};
    Scalar* out = encoding + i * angles.n * kLobeAmplitudes;
    for (int k = 0; k < angles.n; ++k) {
      const LobeResponse<Scalar> at(angles.At(k), o[0], o[1], o[2], lobe[k * kLobeParameters + 2],
                                    lobe[k * kLobeParameters + 3]);
      out[k * kLobeAmplitudes] = lobe[k * kLobeParameters] * at.response;
      out[k * kLobeAmplitudes + 1] = lobe[k * kLobeParameters + 1] * at.response;
    }
  }
}

template <typename Scalar>
NRFF_INLINE void Backward(const Angles<Scalar>& angles, const Scalar* directions, const Scalar* raw, int64_t begin,
                          int64_t end, const Scalar* d_encoding, Scalar* d_directions, Scalar* d_raw) {
  // Per lobe, kept apart so that the loop over lobes has no sums in it and the sums have a fixed order.
  Scalar d_x[kMaxLobes], d_y[kMaxLobes], d_z[kMaxLobes];
  for (int64_t i = begin; i < end; ++i) {
    const Scalar* lobe = raw + i * angles.n * kLobeParameters;
    const Scalar o[3] = {directions[3 * i], directions[3 * i + 1], directions[3 * i + 2]};
    const Scalar* d_out = d_encoding + i * angles.n * kLobeAmplitudes;
    Scalar* d_lobe = d_raw + i * angles.n * kLobeParameters;
    for (int k = 0; k < angles.n; ++k) {
      const LobeResponse<Scalar> at(angles.At(k), o[0], o[1], o[2], lobe[k * kLobeParameters + 2],
                                    lobe[k * kLobeParameters + 3]);
      const LobeGradient<Scalar> d(angles.At(k), at, lobe[k * kLobeParameters], lobe[k * kLobeParameters + 1],
                                   d_out[k * kLobeAmplitudes], d_out[k * kLobeAmplitudes + 1]);
      d_lobe[k * kLobeParameters] = d.d_a0;
      d_lobe[k * kLobeParameters + 1] = d.d_a1;
      d_lobe[k * kLobeParameters + 2] = d.d_raw_lambda;
      d_lobe[k * kLobeParameters + 3] = d.d_raw_mu;
      d_x[k] = d.d_x;
      d_y[k] = d.d_y;
      d_z[k] = d.d_z;
    }
    Scalar sum_x = 0, sum_y = 0, sum_z = 0;
    for (int k = 0; k < angles.n; ++k) {
      sum_x += d_x[k];
      sum_y += d_y[k];
      sum_z += d_z[k];
    }
    d_directions[3 * i] = sum_x;
    d_directions[3 * i + 1] = sum_y;
    d_directions[3 * i + 2] = sum_z;
  }
}

// Per scalar type because multiversioned functions cannot be templates.
NRFF_MULTIVERSION void ForwardBlock(const Angles<float>& angles, const float* directions, const float* raw,
                                    int64_t begin, int64_t end, float* encoding) {
  Forward(angles, directions, raw, begin, end, encoding);
}
void ForwardBlock(const Angles<double>& angles, const double* directions, const double* raw, int64_t begin, int64_t end,
                  double* encoding) {
  Forward(angles, directions, raw, begin, end, encoding);
}
NRFF_MULTIVERSION void BackwardBlock(const Angles<float>& angles, const float* directions, const float* raw,
                                     int64_t begin, int64_t end, const float* d_encoding, float* d_directions,
                                     float* d_raw) {
  Backward(angles, directions, raw, begin, end, d_encoding, d_directions, d_raw);
}
void BackwardBlock(const Angles<double>& angles, const double* directions, const double* raw, int64_t begin,
                   int64_t end, const double* d_encoding, double* d_directions, double* d_raw) {
  Backward(angles, directions, raw, begin, end, d_encoding, d_directions, d_raw);
}

constexpr int64_t kBlock = 64;

template <typename Work>
void ForEachBlock(int64_t n, const Work& work) {
  const int64_t n_blocks = (n + kBlock - 1) / kBlock;
#pragma omp parallel for schedule(static)
  for (int64_t block = 0; block < n_blocks; ++block) work(block * kBlock, std::min(n, (block + 1) * kBlock));
}

}  // namespace

template <typename Scalar>
void ReeForward(const Lobes& lobes, const Scalar* directions, const Scalar* raw, int64_t n, Scalar* encoding) {
  const Angles<Scalar> angles(lobes);
  ForEachBlock(n, [&](int64_t begin, int64_t end) { ForwardBlock(angles, directions, raw, begin, end, encoding); });
}

template <typename Scalar>
void ReeBackward(const Lobes& lobes, const Scalar* directions, const Scalar* raw, int64_t n, const Scalar* d_encoding,
                 Scalar* d_directions, Scalar* d_raw) {
  const Angles<Scalar> angles(lobes);
  ForEachBlock(n, [&](int64_t begin, int64_t end) {
    BackwardBlock(angles, directions, raw, begin, end, d_encoding, d_directions, d_raw);
  });
}

template void ReeForward(const Lobes&, const float*, const float*, int64_t, float*);
template void ReeForward(const Lobes&, const double*, const double*, int64_t, double*);
template void ReeBackward(const Lobes&, const float*, const float*, int64_t, const float*, float*, float*);
template void ReeBackward(const Lobes&, const double*, const double*, int64_t, const double*, double*, double*);

}  // namespace nrff
