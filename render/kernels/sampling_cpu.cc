#include <algorithm>
#include <cmath>
#include <limits>

#include "render/kernels/random.h"
#include "render/kernels/sampling.h"

namespace nrff {
namespace {

// Cells of the point's three axes.
struct Cell {
  int x, y, z;
  bool SameBlock(const Cell& other) const { return ((x ^ other.x) | (y ^ other.y) | (z ^ other.z)) < kOccupancyBlock; }
};

// One ray against one grid. Positions are affine in t: u = uo + t·ud with the box at |u| ≤ 1.
template <typename Scalar>
class RayMarcher {
 public:
  RayMarcher(const MarchArgs<Scalar>& args, int64_t ray)
      : bits_(args.occupancy), last_cell_(args.occupancy.resolution - 1) {
    const Scalar half_resolution = Scalar(0.5) * args.occupancy.resolution;
    const Scalar field_scale = args.map.unbounded ? Scalar(0.5) : Scalar(1);
    Scalar squared_speed = 0;
    for (int k = 0; k < 3; ++k) {
      const Scalar inverse_extent = Scalar(1 / args.map.half_extent[k]);
      uo_[k] = (args.origins[3 * ray + k] - Scalar(args.map.center[k])) * inverse_extent;
      ud_[k] = args.directions[3 * ray + k] * inverse_extent;
      squared_speed += ud_[k] * ud_[k];
      cell_origin_[k] = (field_scale * uo_[k] + 1) * half_resolution;
      cell_speed_[k] = field_scale * ud_[k] * half_resolution;
      cell_time_[k] = 1 / cell_speed_[k];
    }
    SetBoxInterval(Scalar(args.near), Scalar(args.far));
    near_ = Scalar(args.near);
    far_ = Scalar(args.far);
    half_resolution_ = half_resolution;
    field_scale_ = field_scale;
    jitter_ = args.jitter ? Scalar(Uniform(args.jitter_seed, args.jitter_stream, ray)) : Scalar(0);
    step_ = args.map.unbounded ? Scalar(args.step) / std::sqrt(squared_speed) : Scalar(args.step);
  }

  // Calls emit(t, point in field coordinates) for every sample, front to back, until it returns false.
  template <typename Emit>
  void MarchBounded(Emit&& emit) const {
    if (enter_ <= exit_) MarchBox(enter_ + jitter_ * step_, exit_, emit);
  }

  template <typename Emit>
  void MarchUnbounded(Emit&& emit) const {
    Scalar t = near_ + jitter_ * OutsideStep(Norm(near_));
    const bool meets_box = enter_ <= exit_;
    if (!MarchOutside(t, meets_box ? std::min(enter_, far_) : far_, emit) || !meets_box) return;
    if (t <= exit_) {
      const int64_t n_steps = LatticeSize(t, exit_);
      if (!MarchBox(t, exit_, emit)) return;
      t += static_cast<Scalar>(n_steps) * step_;
    }
    MarchOutside(t, far_, emit);
  }

 private:
  // The part of [near, far] inside the box; enter_ > exit_ when there is none. Slab test: a zero direction component
  // never divides, and then only the origin decides.
  void SetBoxInterval(Scalar near, Scalar far) {
    enter_ = near;
    exit_ = far;
    for (int k = 0; k < 3; ++k) {
      if (ud_[k] == 0) {
        if (std::abs(uo_[k]) > 1) exit_ = -std::numeric_limits<Scalar>::infinity();
        continue;
      }
      const Scalar a = (-1 - uo_[k]) / ud_[k], b = (1 - uo_[k]) / ud_[k];
      enter_ = std::max(enter_, std::min(a, b));
      exit_ = std::min(exit_, std::max(a, b));
    }
  }

  // Cells outside by rounding belong to the nearest one. Monotone in t axis by axis, which Skip relies on.
  Cell CellAt(Scalar t) const {
    const auto clamp = [this](Scalar x) { return std::min(std::max(static_cast<int>(x), 0), last_cell_); };
    return {clamp(cell_origin_[0] + t * cell_speed_[0]), clamp(cell_origin_[1] + t * cell_speed_[1]),
            clamp(cell_origin_[2] + t * cell_speed_[2])};
  }

  // Number of i ≥ 0 with t0 + i·step ≤ end.
  int64_t LatticeSize(Scalar t0, Scalar end) const {
    if (!(t0 <= end)) return 0;
    auto n = static_cast<int64_t>((end - t0) / step_) + 2;
    while (n > 0 && t0 + static_cast<Scalar>(n - 1) * step_ > end) --n;
    return n;
  }

  // Positions t0 + i·step up to `end`, all inside the box. Returns false when emit did.
  template <typename Emit>
  bool MarchBox(Scalar t0, Scalar end, Emit&& emit) const {
    const int64_t n = LatticeSize(t0, end);
    for (int64_t i = 0; i < n;) {
      const Scalar t = t0 + static_cast<Scalar>(i) * step_;
      const Cell cell = CellAt(t);
      const size_t block = bits_.BlockOf(cell.x, cell.y, cell.z);
      if (!bits_.blocks[block]) {
        i = Skip(t0, i, n, cell) + 1;
        continue;
      }
      if (bits_.CellOccupied(block, cell.x, cell.y, cell.z)) {
        Scalar point[3];
        for (int k = 0; k < 3; ++k) point[k] = field_scale_ * (uo_[k] + t * ud_[k]);
        if (!emit(t, point)) return false;
      }
      ++i;
    }
    return true;
  }

  // A position j ≥ i, j < n, of the lattice that is in the same block as position i. Since CellAt is monotone, so are
  // all between: they can be jumped over whatever rounding did to the guess.
  int64_t Skip(Scalar t0, int64_t i, int64_t n, const Cell& cell) const {
    const int corner[3] = {cell.x & ~(kOccupancyBlock - 1), cell.y & ~(kOccupancyBlock - 1),
                           cell.z & ~(kOccupancyBlock - 1)};
    Scalar leave = t0 + static_cast<Scalar>(n) * step_;
    for (int k = 0; k < 3; ++k) {
      if (cell_speed_[k] == 0) continue;  // the ray runs along these faces
      const Scalar face = static_cast<Scalar>(corner[k] + (cell_speed_[k] > 0 ? kOccupancyBlock : 0));
      leave = std::min(leave, (face - cell_origin_[k]) * cell_time_[k]);
    }
    int64_t j = std::clamp(static_cast<int64_t>((leave - t0) / step_), i, n - 1);
    while (j > i && !CellAt(t0 + static_cast<Scalar>(j) * step_).SameBlock(cell)) --j;
    return j;
  }

  // max(1, |u|∞), and the step in t there.
  Scalar Norm(Scalar t) const {
    return std::max(
        {Scalar(1), std::abs(uo_[0] + t * ud_[0]), std::abs(uo_[1] + t * ud_[1]), std::abs(uo_[2] + t * ud_[2])});
  }
  Scalar OutsideStep(Scalar norm) const { return step_ * norm * norm; }

  // Growing steps from t until t ≥ end, outside the foreground box; leaves t at the first position not taken. Returns
  // false when emit did, or when the step is too small for t to move.
  template <typename Emit>
  bool MarchOutside(Scalar& t, Scalar end, Emit&& emit) const {
    while (t < end) {
      const Scalar m = Norm(t), scale = SceneMap::ContractionScale(m);
      Scalar point[3];
      int cell[3];
      for (int k = 0; k < 3; ++k) {
        point[k] = scale * (uo_[k] + t * ud_[k]);
        cell[k] = std::min(std::max(static_cast<int>((point[k] + 1) * half_resolution_), 0), last_cell_);
      }
      const size_t block = bits_.BlockOf(cell[0], cell[1], cell[2]);
      if (bits_.blocks[block] && bits_.CellOccupied(block, cell[0], cell[1], cell[2]) && !emit(t, point)) return false;
      const Scalar next = t + OutsideStep(m);
      if (!(next > t)) return false;
      t = next;
    }
    return true;
  }

  OccupancyBits bits_;
  int last_cell_;
  Scalar uo_[3], ud_[3];                   // box coordinates: u = uo + t·ud
  Scalar cell_origin_[3], cell_speed_[3];  // cell coordinates inside the box: cell_origin + t·cell_speed
  Scalar cell_time_[3];                    // 1 / cell_speed
  Scalar enter_, exit_, near_, far_;       // along the ray
  Scalar half_resolution_, field_scale_, jitter_, step_;  // step: in t, inside the box
};

template <typename Scalar, typename Emit>
void March(const MarchArgs<Scalar>& args, int64_t ray, Emit&& emit) {
  const RayMarcher<Scalar> marcher(args, ray);
  if (args.map.unbounded) {
    marcher.MarchUnbounded(emit);
  } else {
    marcher.MarchBounded(emit);
  }
}

}  // namespace

template <typename Scalar>
int64_t CountSamplesCpu(const MarchArgs<Scalar>& args, int64_t* ray_offsets) {
  ray_offsets[0] = 0;
#pragma omp parallel for schedule(dynamic, 64) if (args.n_rays > 128)
  for (int64_t r = 0; r < args.n_rays; ++r) {
    int64_t n = 0;
    March(args, r, [&n](Scalar, const Scalar*) {
      ++n;
      return true;
    });
    ray_offsets[r + 1] = n;
  }
  for (int64_t r = 0; r < args.n_rays; ++r) ray_offsets[r + 1] += ray_offsets[r];
  return ray_offsets[args.n_rays];
}

template <typename Scalar>
void FillSamplesCpu(const MarchArgs<Scalar>& args, const int64_t* ray_offsets, const SampleArrays<Scalar>& samples) {
#pragma omp parallel for schedule(dynamic, 64) if (args.n_rays > 128)
  for (int64_t r = 0; r < args.n_rays; ++r) {
    int64_t i = ray_offsets[r];
    const int64_t end = ray_offsets[r + 1];
    if (i == end) continue;
    March(args, r, [&](Scalar t, const Scalar* point) {
      samples.t[i] = t;
      samples.delta[i] = Scalar(args.step);
      std::copy_n(point, 3, samples.points + 3 * i);
      samples.ray_index[i] = r;
      return ++i < end;
    });
  }
}

template int64_t CountSamplesCpu(const MarchArgs<float>&, int64_t*);
template int64_t CountSamplesCpu(const MarchArgs<double>&, int64_t*);
template void FillSamplesCpu(const MarchArgs<float>&, const int64_t*, const SampleArrays<float>&);
template void FillSamplesCpu(const MarchArgs<double>&, const int64_t*, const SampleArrays<double>&);

}  // namespace nrff
