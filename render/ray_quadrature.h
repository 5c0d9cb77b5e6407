// Colours of rays with as few shaded points as a tolerance allows: adaptive quadrature of Σ w c along a ray.
//
// Neighbouring samples of little weight become one, at their mean. These are taken in spans, first of a quarter of a
// ray's light each. A span is shaded once, with the weighted mean of what its samples have in common
// (RadianceField::Shader): exact where colour is linear in that, else off by about ½ c'' w Var(t). How large c'' may be
// is seen from the neighbouring spans' colours; spans for which that is too much are halved and shaded anew. On the
// paper's model at the tolerance of 8-bit pictures a tenth as many points are shaded as there are samples, and pictures
// agree to 62 dB with those of all samples (tests/bench/results/views.json).
#pragma once

#include <cstdint>
#include <vector>

#include "render/radiance_field.h"
#include "render/ray_block.h"

namespace nrff {

class RayQuadrature {
 public:
  // Of the samples that block.Select() chose. directions [n_rays, 3] unit. `step`: between neighbouring samples, in
  // units of block.t. `tolerance`: of a ray's colour; 0: every sample is shaded by itself.
  void Integrate(const RayBlock& block, const float* directions, double step, float tolerance,
                 RadianceField::Shader& shader);

  std::vector<float> rgb, normals;  // [n_rays, 3]: Σ w c, Σ w n over the selected samples
  int64_t n_shaded = 0;             // spans shaded

 private:
  struct RaySpan {
    int64_t ray;
    RadianceField::Shader::Span samples;  // or pairs
    float weight, t, variance;            // sum; mean and variance along the ray
    bool shaded;
    float rgb[3], normal[3];
  };

  // The selected samples, or pairs of them.
  void Gather(const RayBlock& block, float step, float tolerance);
  void Start(float step, float tolerance);
  void AddSpan(int64_t ray, int64_t begin, int64_t end);
  void ShadeNew(const float* directions, RadianceField::Shader& shader);
  // Whether there are new spans.
  bool Split(float tolerance);
  float ErrorEstimate(size_t span) const;

  std::vector<int64_t> offsets_;             // [n_rays + 1]: where a ray's samples begin
  std::vector<float> points_, weights_, t_;  // of the samples, or pairs
  std::vector<RaySpan> spans_, split_;       // by ray, front to back
  std::vector<size_t> new_;                  // of spans_
  std::vector<RadianceField::Shader::Span> new_samples_;
  std::vector<float> new_directions_, new_rgb_, new_normals_;
};

}  // namespace nrff
