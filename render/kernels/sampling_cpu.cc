#include <algorithm>

#include "render/kernels/ray_marcher.h"
#include "render/kernels/sampling.h"

namespace nrff {

template <typename Scalar>
int64_t CountSamplesCpu(const MarchArgs<Scalar>& args, int64_t* ray_offsets) {
  ray_offsets[0] = 0;
#pragma omp parallel for schedule(dynamic, 64) if (args.n_rays > 128)
  for (int64_t r = 0; r < args.n_rays; ++r) {
    RayMarcher<Scalar> marcher(args, r);
    int64_t n = 0;
    Scalar t, point[3];
    while (marcher.Next(t, point)) ++n;
    ray_offsets[r + 1] = n;
  }
  for (int64_t r = 0; r < args.n_rays; ++r) ray_offsets[r + 1] += ray_offsets[r];
  return ray_offsets[args.n_rays];
}

template <typename Scalar>
void FillSamplesCpu(const MarchArgs<Scalar>& args, const int64_t* ray_offsets, const SampleArrays<Scalar>& samples) {
#pragma omp parallel for schedule(dynamic, 64) if (args.n_rays > 128)
  for (int64_t r = 0; r < args.n_rays; ++r) {
    RayMarcher<Scalar> marcher(args, r);
    for (int64_t i = ray_offsets[r]; i < ray_offsets[r + 1]; ++i) {
      marcher.Next(samples.t[i], samples.points + 3 * i);
      samples.delta[i] = Scalar(args.step);
      samples.ray_index[i] = r;
    }
  }
}

template int64_t CountSamplesCpu(const MarchArgs<float>&, int64_t*);
template int64_t CountSamplesCpu(const MarchArgs<double>&, int64_t*);
template void FillSamplesCpu(const MarchArgs<float>&, const int64_t*, const SampleArrays<float>&);
template void FillSamplesCpu(const MarchArgs<double>&, const int64_t*, const SampleArrays<double>&);

}  // namespace nrff
