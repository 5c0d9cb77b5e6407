// One lobe of ree.h in one direction, shared by the CPU and CUDA twins.
#pragma once

#include "model/kernels/fast_math.h"
#include "model/kernels/simd.h"

namespace nrff {

template <typename Scalar>
struct Lobe {
  Scalar sin_theta, cos_theta, sin_phi, cos_phi;
};

// What a lobe of amplitude one gives, and what its gradient needs.
template <typename Scalar>
struct LobeResponse {
  Scalar along, at_lambda, at_mu;  // o·axis, o·axis_λ, o·axis_μ
  Scalar lambda, mu, d_softplus_lambda, d_softplus_mu;
  Scalar gaussian, response;

  NRFF_INLINE LobeResponse(const Lobe<Scalar>& lobe, Scalar x, Scalar y, Scalar z, Scalar raw_lambda, Scalar raw_mu) {
    const Scalar across = x * lobe.cos_phi + y * lobe.sin_phi;  // along the axis's projection to the xy plane
    along = across * lobe.sin_theta + z * lobe.cos_theta;
    at_lambda = across * lobe.cos_theta - z * lobe.sin_theta;
    at_mu = y * lobe.cos_phi - x * lobe.sin_phi;
    FastSoftplus(raw_lambda - 1, lambda, d_softplus_lambda);
    FastSoftplus(raw_mu - 1, mu, d_softplus_mu);
    gaussian = FastExp(-lambda * at_lambda * at_lambda - mu * at_mu * at_mu);
    response = (along > 0 ? along : Scalar(0)) * gaussian;
  }
};

// What the gradients of the lobe's two values, d0 and d1, ask of its amplitudes a0 and a1, raw λ and μ, and of o.
template <typename Scalar>
struct LobeGradient {
  Scalar d_a0, d_a1, d_raw_lambda, d_raw_mu, d_x, d_y, d_z;

  NRFF_INLINE LobeGradient(const Lobe<Scalar>& lobe, const LobeResponse<Scalar>& at, Scalar a0, Scalar a1, Scalar d0,
                           Scalar d1) {
    const Scalar d_response = d0 * a0 + d1 * a1;
    const Scalar d_exponent = d_response * at.response;
    d_a0 = d0 * at.response;
    d_a1 = d1 * at.response;
    d_raw_lambda = -d_exponent * at.at_lambda * at.at_lambda * at.d_softplus_lambda;
    d_raw_mu = -d_exponent * at.at_mu * at.at_mu * at.d_softplus_mu;
    const Scalar d_along = at.along > 0 ? d_response * at.gaussian : Scalar(0);
    const Scalar d_at_lambda = -2 * d_exponent * at.lambda * at.at_lambda;
    const Scalar d_at_mu = -2 * d_exponent * at.mu * at.at_mu;
    const Scalar d_across = d_along * lobe.sin_theta + d_at_lambda * lobe.cos_theta;
    d_x = d_across * lobe.cos_phi - d_at_mu * lobe.sin_phi;
    d_y = d_across * lobe.sin_phi + d_at_mu * lobe.cos_phi;
    d_z = d_along * lobe.cos_theta - d_at_lambda * lobe.sin_theta;
  }
};

}  // namespace nrff
