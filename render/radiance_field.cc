#include "render/radiance_field.h"

#include <ATen/ops/from_blob.h>
#include <c10/core/GradMode.h>

#include <algorithm>

namespace nrff {
namespace {

torch::Tensor View(const float* rows, int64_t n) {
  return at::from_blob(const_cast<float*>(rows), {n, 3}, at::kFloat);
}

void CopyOut(const torch::Tensor& from, float* to) {
  const torch::Tensor values = from.to(at::kFloat).contiguous();
  std::copy_n(values.const_data_ptr<float>(), values.numel(), to);
}

class TensorShader : public RadianceField::Shader {
 public:
  explicit TensorShader(const RadianceField& field) : field_(field) {}
  void Shade(const float* points, const float* ray_directions, int64_t n, float* rgb, float* normals) override {
    const c10::NoGradGuard no_grad;
    const RadianceField::Shading shading = field_.Shade(View(points, n), View(ray_directions, n));
    CopyOut(shading.rgb, rgb);
    CopyOut(shading.normal, normals);
  }

 private:
  const RadianceField& field_;
};

}  // namespace

void RadianceField::DensityOf(const float* points, int64_t n, float* sigma) const {
  const c10::NoGradGuard no_grad;
  CopyOut(Density(View(points, n)), sigma);
}

std::unique_ptr<RadianceField::Shader> RadianceField::MakeShader() const {
  return std::make_unique<TensorShader>(*this);
}

}  // namespace nrff
