// One training step on the CPU: rays → loss → gradients of all parameters, by a fixed sequence of kernels with the
// backward pass written by hand. float, all cores, no allocation once its buffers have grown.
//
//   1  trace       rays in blocks: march, density, weights                          (render/ray_block.h)
//   2  shade       samples of enough weight in tiles of whole rays: networks forward, compositing, loss, networks
//                  backward; per sample the gradients of density and of appearance features remain
//   3  scatter     into the grids, one plane ⊙ line product per task: no two threads write to one place
//   4  reduce      the threads' sums of the networks' gradients
//
// What is not computed, and what that changes:
//   empty cells of the occupancy grid        approximate: opacity below the grid's threshold is taken for none
//   samples behind T < stop_transmittance    a ray's colour lacks less than stop_transmittance
//   colours of samples of weight ≤ threshold a ray's colour lacks at most the sum of those weights
// Gradients are exact for the colours so computed. The sparsity loss sees the samples before the stop alone.
// On one thread, results are the same bits every time; on several, the sums of step 4 depend on which thread took which
// tile.
#pragma once

#include <torch/types.h>

#include <cstdint>
#include <memory>
#include <vector>

#include "model/depth_batch.h"
#include "model/nrff_field.h"
#include "model/ray_batch.h"
#include "render/occupancy_grid.h"
#include "render/ray_block.h"
#include "render/volume_renderer.h"

namespace nrff {

struct LossWeights {
  double orientation = 0, density_l1 = 0, sparsity = 0, depth = 0, correction = 0;  // losses.h
};

class TrainingStep {
 public:
  // Keeps a reference to the field.
  explicit TrainingStep(const NrffField& field);

  struct Result {
    double mse = 0, orientation = 0, sparsity = 0, depth = 0;  // as in losses.h, without their weights
    int64_t n_samples = 0;                                     // density evaluations
    int64_t n_shaded = 0;
  };

  // Overwrites gradients(). `depths` may be null. The background is options.background. The batch's views are those of
  // the field's colour corrections, where it has any.
  Result Run(const PixelSource::Batch& batch, const DepthSource::Batch* depths, const OccupancyGrid& occupancy,
             const SceneMap& map, const RenderOptions& options, const LossWeights& weights);

  // As field.parameters(), in their order and shapes.
  const std::vector<torch::Tensor>& gradients() const { return gradients_; }

 private:
  // Whole rays of a block whose samples are worked on together, and what they leave for the grids.
  struct Tile {
    int block = 0;
    int64_t first_ray = 0, end_ray = 0;
    bool depth = false;                            // of rays that should end somewhere, not of rays with a colour
    std::vector<float> points;                     // [n, 3] of the shaded samples
    std::vector<float> d_features;                 // [n_products][n][C]
    std::vector<float> density_points, d_density;  // [m, 3], [m]: dL/df of samples that have any
  };
  struct Thread {
    explicit Thread(const ShadingNetworks& networks) : tile(networks, /*backward=*/true), gradients(networks) {}
    ShadingTile tile;
    ShadingGradients gradients;
    std::vector<float> features, directions, d_weights, d_sigma, d_transmittance;
    std::vector<float> d_corrections;  // [corrected_views, 12]
    double mse = 0, orientation = 0, sparsity = 0, depth = 0;
  };
  struct Batch;

  void MakeTiles(int64_t n_colour_blocks);
  void ShadeTile(const Batch& batch, Tile& tile, Thread& thread);
  void Composite(const Batch& batch, const Tile& tile, Thread& thread);
  void MatchDepths(const Batch& batch, Tile& tile, Thread& thread);
  void BackwardDensity(const Batch& batch, Tile& tile, Thread& thread);
  void Scatter(int task, double density_l1);
  void ReduceNetworks();
  void ReduceCorrections(double weight);

  const NrffField& field_;
  ShadingNetworks networks_;
  PackedNetworks packed_;
  std::vector<torch::Tensor> gradients_;
  std::vector<std::unique_ptr<Thread>> threads_;
  int n_team_ = 0;  // of them took part in this step
  std::vector<RayBlock> blocks_;
  std::vector<Tile> tiles_;  // of all steps; those of this one are the first n_tiles_
  int64_t n_tiles_ = 0;
  std::vector<int> scatter_tasks_;  // products, appearance's after density's; the largest first
};

}  // namespace nrff
