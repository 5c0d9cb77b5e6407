#include "model/kernel_functions.h"

#include <ATen/ATen.h>
#include <torch/csrc/autograd/custom_function.h>

#include <stdexcept>

namespace nrff {
namespace {

using torch::Tensor;
using torch::autograd::AutogradContext;
using torch::autograd::tensor_list;

// Calls body(Scalar{}) with the tensor's scalar type.
template <typename Body>
void WithScalar(const Tensor& tensor, Body&& body) {
  if (tensor.scalar_type() == torch::kFloat) {
    body(float{});
  } else if (tensor.scalar_type() == torch::kDouble) {
    body(double{});
  } else {
    throw std::invalid_argument(std::string("kernels take float or double, not ") +
                                c10::toString(tensor.scalar_type()));
  }
}

template <typename Scalar>
const Scalar* In(const Tensor& tensor) {
  return tensor.const_data_ptr<Scalar>();
}
template <typename Scalar>
Scalar* Out(Tensor& tensor) {
  return tensor.mutable_data_ptr<Scalar>();
}

constexpr char kShared[] = "shared";

template <typename Shared>
void Keep(AutogradContext* ctx, const c10::intrusive_ptr<Shared>& shared) {
  ctx->saved_data[kShared] = c10::IValue::make_capsule(shared);
}
template <typename Shared>
c10::intrusive_ptr<Shared> Kept(AutogradContext* ctx) {
  return c10::static_intrusive_pointer_cast<Shared>(ctx->saved_data[kShared].toCapsule());
}

enum class ReadOut { kConcat, kSum };

template <ReadOut kReadOut>
class GridFunction : public torch::autograd::Function<GridFunction<kReadOut>> {
 public:
  static Tensor forward(AutogradContext* ctx, const GridLayoutPtr& shared, const Tensor& parameters,
                        const Tensor& points_in) {
    constexpr auto kConcat = kReadOut == ReadOut::kConcat;
    const Tensor points = points_in.contiguous();
    const GridLayout& layout = shared->layout;
    const int64_t n = points.size(0);
    Tensor features = kConcat ? at::empty({layout.n_products(), n, layout.n_channels}, points.options())
                              : at::empty({n}, points.options());
    WithScalar(parameters, [&](auto scalar) {
      using Scalar = decltype(scalar);
      constexpr auto* kForward = kConcat ? GridConcatForward<Scalar> : GridSumForward<Scalar>;
      kForward(layout, In<Scalar>(parameters), In<Scalar>(points), n, Out<Scalar>(features));
    });
    Keep(ctx, shared);
    ctx->save_for_backward({parameters, points});
    return kConcat ? features.permute({1, 0, 2}).reshape({n, layout.n_features()}) : features;
  }

  static tensor_list backward(AutogradContext* ctx, const tensor_list& grads) {
    constexpr auto kConcat = kReadOut == ReadOut::kConcat;
    const tensor_list saved = ctx->get_saved_variables();
    const Tensor &parameters = saved[0], &points = saved[1];
    const auto shared = Kept<SharedGridLayout>(ctx);
    const GridLayout& layout = shared->layout;
    const int64_t n = points.size(0);
    const Tensor d_features =
        kConcat ? grads[0].reshape({n, layout.n_products(), layout.n_channels}).permute({1, 0, 2}).contiguous()
                : grads[0].contiguous();
    Tensor d_parameters = at::zeros_like(parameters);
    WithScalar(parameters, [&](auto scalar) {
      using Scalar = decltype(scalar);
      constexpr auto* kBackward = kConcat ? GridConcatBackward<Scalar> : GridSumBackward<Scalar>;
      for (int p = 0; p < layout.n_products(); ++p) {
        kBackward(layout, p, In<Scalar>(parameters), In<Scalar>(points), n,
                  In<Scalar>(d_features) + (kConcat ? p * n * layout.n_channels : 0), Out<Scalar>(d_parameters));
      }
    });
    return {{}, d_parameters, {}};
  }
};

class ReeFunction : public torch::autograd::Function<ReeFunction> {
 public:
  static Tensor forward(AutogradContext* ctx, const LobesPtr& shared, const Tensor& directions_in,
                        const Tensor& raw_in) {
    const Tensor directions = directions_in.contiguous(), raw = raw_in.contiguous();
    Tensor encoding = at::empty({raw.size(0), shared->lobes.size() * kLobeAmplitudes}, raw.options());
    WithScalar(raw, [&](auto scalar) {
      using Scalar = decltype(scalar);
      ReeForward(shared->lobes, In<Scalar>(directions), In<Scalar>(raw), raw.size(0), Out<Scalar>(encoding));
    });
    Keep(ctx, shared);
    ctx->save_for_backward({directions, raw});
    return encoding;
  }

  static tensor_list backward(AutogradContext* ctx, const tensor_list& grads) {
    const tensor_list saved = ctx->get_saved_variables();
    const Tensor &directions = saved[0], &raw = saved[1];
    const Tensor d_encoding = grads[0].contiguous();
    Tensor d_directions = at::empty_like(directions), d_raw = at::empty_like(raw);
    WithScalar(raw, [&](auto scalar) {
      using Scalar = decltype(scalar);
      ReeBackward(Kept<SharedLobes>(ctx)->lobes, In<Scalar>(directions), In<Scalar>(raw), raw.size(0),
                  In<Scalar>(d_encoding), Out<Scalar>(d_directions), Out<Scalar>(d_raw));
    });
    return {{}, d_directions, d_raw};
  }
};

}  // namespace

Tensor GridConcat(const GridLayoutPtr& layout, const Tensor& parameters, const Tensor& points) {
  return GridFunction<ReadOut::kConcat>::apply(layout, parameters, points);
}

Tensor GridSum(const GridLayoutPtr& layout, const Tensor& parameters, const Tensor& points) {
  return GridFunction<ReadOut::kSum>::apply(layout, parameters, points);
}

Tensor ReeEncode(const LobesPtr& lobes, const Tensor& directions, const Tensor& raw) {
  return ReeFunction::apply(lobes, directions, raw);
}

}  // namespace nrff
