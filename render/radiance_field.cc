#include "render/radiance_field.h"

#include <ATen/ops/from_blob.h>
#include <c10/core/GradMode.h>

#include <algorithm>
#include <vector>

namespace nrff {
namespace {

torch::Tensor View(const float* rows, int64_t n) { return at::from_blob(const_cast<float*>(rows), {n, 3}, at::kFloat); }

void CopyOut(const torch::Tensor& from, float* to) {
  const torch::Tensor values = from.to(at::kFloat).contiguous();
  std::copy_n(values.const_data_ptr<float>(), values.numel(), to);
}

// Knows nothing that samples have in common but where they are: a span is shaded at its mean point.
class TensorShader : public RadianceField::Shader {
 public:
  explicit TensorShader(const RadianceField& field) : field_(field) {}

  void SetSamples(const float* points, const float* weights, int64_t n) override {
    points_.assign(points, points + 3 * n);
    weights_.assign(weights, weights + n);
  }

  void Shade(const Span* spans, const float* ray_directions, int64_t n, float* rgb, float* normals) override {
    means_.resize(3 * n);
    for (int64_t s = 0; s < n; ++s) {
      double sum[3] = {}, weight = 0;
      for (int64_t i = spans[s].begin; i < spans[s].end; ++i) {
        weight += weights_[i];
        for (int k = 0; k < 3; ++k) sum[k] += double{weights_[i]} * points_[3 * i + k];
      }
      for (int k = 0; k < 3; ++k) means_[3 * s + k] = static_cast<float>(sum[k] / weight);
    }
    const c10::NoGradGuard no_grad;
    const RadianceField::Shading shading = field_.Shade(View(means_.data(), n), View(ray_directions, n));
    CopyOut(shading.rgb, rgb);
    CopyOut(shading.normal, normals);
  }

 private:
  const RadianceField& field_;
  std::vector<float> points_, weights_, means_;
};

}  // namespace

void RadianceField::DensityOf(const float* points, int64_t n, float* sigma) const {
  const c10::NoGradGuard no_grad;
  CopyOut(Density(View(points, n)), sigma);
}

std::unique_ptr<RadianceField> RadianceField::WithoutFinestLevels(int /*n*/) const { return nullptr; }

std::unique_ptr<RadianceField::Shader> RadianceField::MakeShader(ShadingPrecision /*precision*/) const {
  return std::make_unique<TensorShader>(*this);
}

}  // namespace nrff
