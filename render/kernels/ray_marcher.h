// One ray on its way through the occupied cells: the positions of sampling.h, one by one.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "render/kernels/random.h"
#include "render/kernels/sampling.h"

namespace nrff {

// Positions are affine in t: u = uo + t·ud with the box at |u| ≤ 1.
template <typename Scalar>
class RayMarcher {
 public:
  RayMarcher() = default;  // has nothing to give
  NRFF_HOST_DEVICE RayMarcher(const MarchArgs<Scalar>& args, int64_t ray)
      : bits_(args.occupancy), last_cell_(args.occupancy.resolution - 1), unbounded_(args.map.unbounded) {
    half_resolution_ = Scalar(0.5) * args.occupancy.resolution;
    field_scale_ = args.map.unbounded ? Scalar(0.5) : Scalar(1);
    Scalar squared_speed = 0;
    for (int k = 0; k < 3; ++k) {
      const Scalar inverse_extent = Scalar(1 / args.map.half_extent[k]);
      uo_[k] = (args.origins[3 * ray + k] - Scalar(args.map.center[k])) * inverse_extent;
      ud_[k] = args.directions[3 * ray + k] * inverse_extent;
      squared_speed += ud_[k] * ud_[k];
      cell_origin_[k] = (field_scale_ * uo_[k] + 1) * half_resolution_;
      cell_speed_[k] = field_scale_ * ud_[k] * half_resolution_;
      cell_time_[k] = 1 / cell_speed_[k];
    }
    const Scalar near = Scalar(args.near);
    far_ = Scalar(args.far);
    FindBox(near, far_);
    const Scalar jitter = args.jitter ? Scalar(Uniform(args.jitter_seed, args.jitter_stream, ray)) : Scalar(0);
    step_ = args.map.unbounded ? Scalar(args.step) / std::sqrt(squared_speed) : Scalar(args.step);
    if (args.map.unbounded) {
      phase_ = Phase::kBefore;
      t_ = near + jitter * OutsideStep(Norm(near));
      outside_end_ = enter_ <= exit_ ? std::min(enter_, far_) : far_;
    } else if (enter_ <= exit_) {
      StartBox(enter_ + jitter * step_);
    }
  }

  // The next sample: its distance and its field coordinates. False when there is none left.
  NRFF_HOST_DEVICE bool Next(Scalar& t, Scalar point[3]) {
    while (phase_ != Phase::kDone) {
      if (phase_ == Phase::kBox) {
        if (NextInBox(t, point)) return true;
        // What lies behind the box of a bounded scene is nothing.
        phase_ = unbounded_ ? Phase::kBehind : Phase::kDone;
        t_ = start_ + static_cast<Scalar>(n_positions_) * step_;
        outside_end_ = far_;
        continue;
      }
      if (NextOutside(t, point)) return true;
      if (phase_ == Phase::kBefore && enter_ <= exit_ && t_ <= exit_) {
        StartBox(t_);
      } else if (phase_ == Phase::kBefore && enter_ <= exit_) {
        phase_ = Phase::kBehind;
        outside_end_ = far_;
      } else {
        phase_ = Phase::kDone;
      }
    }
    return false;
  }

 private:
  enum class Phase : uint8_t { kBefore, kBox, kBehind, kDone };

  // Cells of a point's three axes.
  struct Cell {
    int x, y, z;
    NRFF_HOST_DEVICE bool SameBlock(const Cell& other) const {
      return ((x ^ other.x) | (y ^ other.y) | (z ^ other.z)) < kOccupancyBlock;
    }
  };

  // The part of [near, far] inside the box; enter_ > exit_ when there is none. Slab test: a zero direction component
  // never divides, and then only the origin decides.
  NRFF_HOST_DEVICE void FindBox(Scalar near, Scalar far) {
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
  NRFF_HOST_DEVICE Cell CellAt(Scalar t) const {
    const auto clamp = [this](Scalar x) { return std::min(std::max(static_cast<int>(x), 0), last_cell_); };
    return {clamp(cell_origin_[0] + t * cell_speed_[0]), clamp(cell_origin_[1] + t * cell_speed_[1]),
            clamp(cell_origin_[2] + t * cell_speed_[2])};
  }

  // Number of i ≥ 0 with t0 + i·step ≤ end.
  NRFF_HOST_DEVICE int64_t LatticeSize(Scalar t0, Scalar end) const {
    if (!(t0 <= end)) return 0;
    auto n = static_cast<int64_t>((end - t0) / step_) + 2;
    while (n > 0 && t0 + static_cast<Scalar>(n - 1) * step_ > end) --n;
    return n;
  }

  // A position j ≥ i, j < n, of the lattice that is in the same block as position i. Since CellAt is monotone, so are
  // all between: they can be jumped over whatever rounding did to the guess.
  NRFF_HOST_DEVICE int64_t Skip(int64_t i, const Cell& cell) const {
    const int corner[3] = {cell.x & ~(kOccupancyBlock - 1), cell.y & ~(kOccupancyBlock - 1),
                           cell.z & ~(kOccupancyBlock - 1)};
    Scalar leave = start_ + static_cast<Scalar>(n_positions_) * step_;
    for (int k = 0; k < 3; ++k) {
      if (cell_speed_[k] == 0) continue;  // the ray runs along these faces
      const Scalar face = static_cast<Scalar>(corner[k] + (cell_speed_[k] > 0 ? kOccupancyBlock : 0));
      leave = std::min(leave, (face - cell_origin_[k]) * cell_time_[k]);
    }
    int64_t j = std::clamp(static_cast<int64_t>((leave - start_) / step_), i, n_positions_ - 1);
    while (j > i && !CellAt(start_ + static_cast<Scalar>(j) * step_).SameBlock(cell)) --j;
    return j;
  }

  // max(1, |u|∞), and the step in t there.
  NRFF_HOST_DEVICE Scalar Norm(Scalar t) const {
    return std::max(
        {Scalar(1), std::abs(uo_[0] + t * ud_[0]), std::abs(uo_[1] + t * ud_[1]), std::abs(uo_[2] + t * ud_[2])});
  }
  NRFF_HOST_DEVICE Scalar OutsideStep(Scalar norm) const { return step_ * norm * norm; }

  NRFF_HOST_DEVICE void StartBox(Scalar start) {
    phase_ = Phase::kBox;
    start_ = start;
    position_ = 0;
    n_positions_ = LatticeSize(start, exit_);
  }

  // Positions start + i·step up to the exit, all inside the box.
  NRFF_HOST_DEVICE bool NextInBox(Scalar& t_out, Scalar point[3]) {
    while (position_ < n_positions_) {
      const Scalar t = start_ + static_cast<Scalar>(position_) * step_;
      const Cell cell = CellAt(t);
      const size_t block = bits_.BlockOf(cell.x, cell.y, cell.z);
      if (!bits_.blocks[block]) {
        position_ = Skip(position_, cell) + 1;
        continue;
      }
      ++position_;
      if (!bits_.CellOccupied(block, cell.x, cell.y, cell.z)) continue;
      for (int k = 0; k < 3; ++k) point[k] = field_scale_ * (uo_[k] + t * ud_[k]);
      t_out = t;
      return true;
    }
    return false;
  }

  // Growing steps from t_ until t_ ≥ outside_end_, outside the foreground box; leaves t_ at the first position not
  // taken. Also ends when the step is too small for t_ to move.
  NRFF_HOST_DEVICE bool NextOutside(Scalar& t_out, Scalar point[3]) {
    while (t_ < outside_end_) {
      const Scalar m = Norm(t_), scale = SceneMap::ContractionScale(m), t = t_;
      int cell[3];
      for (int k = 0; k < 3; ++k) {
        point[k] = scale * (uo_[k] + t * ud_[k]);
        cell[k] = std::min(std::max(static_cast<int>((point[k] + 1) * half_resolution_), 0), last_cell_);
      }
      const size_t block = bits_.BlockOf(cell[0], cell[1], cell[2]);
      t_ = t + OutsideStep(m);
      if (!(t_ > t)) {
        phase_ = Phase::kDone;
        return false;
      }
      if (!bits_.blocks[block] || !bits_.CellOccupied(block, cell[0], cell[1], cell[2])) continue;
      t_out = t;
      return true;
    }
    return false;
  }

  OccupancyBits bits_{};
  int last_cell_ = 0;
  bool unbounded_ = false;
  Phase phase_ = Phase::kDone;
  Scalar uo_[3], ud_[3];                         // box coordinates: u = uo + t·ud
  Scalar cell_origin_[3], cell_speed_[3];        // cell coordinates inside the box: cell_origin + t·cell_speed
  Scalar cell_time_[3];                          // 1 / cell_speed
  Scalar enter_, exit_, far_;                    // along the ray
  Scalar half_resolution_, field_scale_, step_;  // step: in t, inside the box
  Scalar start_;                                 // of the positions inside the box
  int64_t position_ = 0, n_positions_ = 0;
  Scalar t_, outside_end_;  // the next position outside the box, and where those end
};

}  // namespace nrff
