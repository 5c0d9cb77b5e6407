#include "model/depth_batch.h"

#include <ATen/ATen.h>

#include <cmath>
#include <utility>

#include "render/kernels/random.h"

namespace nrff {

DepthSource::DepthSource(const Scene& scene, std::vector<SparseDepth> depths) : depths_(std::move(depths)) {
  for (const View& view : scene.views) {
    centers_.push_back({view.scene_from_camera[3], view.scene_from_camera[7], view.scene_from_camera[11]});
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
    const SparseDepth& depth = depths_[UniformBelow(depths_.size(), seed, stream, i)];
    const Vec3& center = centers_[depth.view];
    const Vec3 position{depth.position[0], depth.position[1], depth.position[2]};
    Vec3 direction{position[0] - center[0], position[1] - center[1], position[2] - center[2]};
    const double norm = std::hypot(direction[0], direction[1], direction[2]);
    for (int k = 0; k < 3; ++k) {
      direction[k] /= norm;
      origins[3 * i + k] = float(center[k]);
      directions[3 * i + k] = float(direction[k]);
    }
    distance[i] = float(norm);
    spread[i] = float(std::hypot(depth.sigma, map.StepAt(position.data(), direction.data(), march_step)));
  }
  return batch;
}

}  // namespace nrff
