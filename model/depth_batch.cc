#include "model/depth_batch.h"

#include <ATen/ATen.h>

#include "render/kernels/random.h"

namespace nrff {

DepthSource::DepthSource(const Scene& scene, const std::vector<SparseDepth>& depths) {
  for (const SparseDepth& depth : depths) {
    const Mat4& m = scene.views[depth.view].scene_from_camera;
    targets_.push_back({{m[3], m[7], m[11]}, {depth.position[0], depth.position[1], depth.position[2]}, depth.sigma});
  }
}

DepthSource::Batch DepthSource::Draw(int64_t n, uint64_t seed, uint64_t step, const SceneMap& map,
                                     double march_step) const {
  const uint64_t stream = StreamAt(RandomStream::kDepthBatch, step);
  Batch batch{{at::empty({n, 3}, torch::kFloat), at::empty({n, 3}, torch::kFloat)},
              at::empty({n}, torch::kFloat),
              at::empty({n}, torch::kFloat)};
  auto* origins = batch.rays.origins.mutable_data_ptr<float>();
  auto* directions = batch.rays.directions.mutable_data_ptr<float>();
  auto* distance = batch.distance.mutable_data_ptr<float>();
  auto* spread = batch.spread.mutable_data_ptr<float>();
  for (int64_t i = 0; i < n; ++i) {
    DepthRay(targets_[UniformBelow(targets_.size(), seed, stream, i)], map, march_step, origins + 3 * i,
             directions + 3 * i, distance + i, spread + i);
  }
  return batch;
}

}  // namespace nrff
