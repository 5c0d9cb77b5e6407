#include "model/grid_crop.h"

#include <ATen/ATen.h>

namespace nrff {
namespace {

using torch::Tensor;

// [resolution new nodes, resolution old nodes]: rows hold the weights of linear interpolation.
Tensor Interpolation(int resolution, double min, double max, const at::TensorOptions& options) {
  const Tensor nodes = at::linspace(min, max, resolution, options.dtype(torch::kDouble));
  const Tensor position = ((nodes + 1) * (0.5 * (resolution - 1))).clamp(0, resolution - 1);
  const Tensor old_nodes = at::arange(resolution, options.dtype(torch::kDouble));
  return (1 - (position.unsqueeze(1) - old_nodes).abs()).clamp_min(0).to(options.dtype());
}

}  // namespace

Tensor CropGrid(const GridLayout& layout, const Tensor& parameters, const std::array<double, 3>& min,
                const std::array<double, 3>& max) {
  Tensor cropped = at::empty_like(parameters);
  for (const GridLayout::Level& level : layout.levels) {
    const int64_t n = level.resolution, n_channels = layout.n_channels;
    std::array<Tensor, 3> weights;
    for (int axis = 0; axis < 3; ++axis)
      weights[axis] = Interpolation(int(n), min[axis], max[axis], parameters.options());
    for (int p = 0; p < 3; ++p) {
      const auto& [column_axis, row_axis, line_axis, plane_name, line_name] = kGridProducts[p];
      const Tensor plane = parameters.narrow(0, level.plane_offsets[p], n * n * n_channels).view({n, n, n_channels});
      const Tensor rows = at::matmul(weights[row_axis], plane.view({n, n * n_channels})).view({n, n, n_channels});
      cropped.narrow(0, level.plane_offsets[p], n * n * n_channels)
          .copy_(at::matmul(weights[column_axis].unsqueeze(0), rows).flatten());
      const Tensor line = parameters.narrow(0, level.line_offsets[p], n * n_channels).view({n, n_channels});
      cropped.narrow(0, level.line_offsets[p], n * n_channels).copy_(at::matmul(weights[line_axis], line).flatten());
    }
  }
  return cropped;
}

}  // namespace nrff
