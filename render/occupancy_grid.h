// Where samples are worth taking: a cube of cells over field coordinates [-1, 1]³, each with the opacity
// 1 − exp(−σ·step) it was last seen with and a bit that says whether rays are sampled in it.
//
// A cell whose opacity is measured keeps max(decay·old, new) [Mueller22], so that a cell the random point missed once
// is not lost. A cell is occupied when cameras see it (MarkSeen) and its opacity reaches min(threshold, mean opacity of
// the seen cells), or was never measured; the mean keeps a field that is nearly empty everywhere, as at the start, from
// losing all its cells.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "pipeline/scene.h"
#include "render/kernels/occupancy_bits.h"
#include "render/scene_map.h"

namespace nrff {

class DensitySource;

class OccupancyGrid {
 public:
  // Everything is seen and occupied. `resolution` cells per axis: a multiple of 8, else InputError.
  explicit OccupancyGrid(int resolution);

  struct UpdateOptions {
    double step = 0.01;  // the length opacity is taken over; Samples::delta's unit
    float decay = 0.95F;
    float threshold = 0.01F;  // opacity
    // Cells measured: so many drawn from all that are seen, and so many from the occupied ones; 0 and 0: every seen
    // cell. Cells not drawn keep their opacity.
    int64_t n_random = 0, n_occupied = 0;
    uint64_t seed = 0, counter = 0;  // of the draws and of the point in the cell (render/kernels/random.h)
    bool dilate = false;  // also the 26 neighbours of an occupied cell (3³ max-pool of the paper's schedule)
  };
  // Evaluates the density at a random point (float) in each chosen cell, without gradients, and sets the bits anew.
  void Update(const DensitySource& field, const UpdateOptions& options);

  // Only cells that at least `min_views` of the views see remain sampled, from now on. A view sees a cell when its
  // frustum beyond `near` (scene units) meets any of it.
  void MarkSeen(const std::vector<View>& views, const SceneMap& map, double near, int min_views);

  int resolution() const { return resolution_; }
  // Valid until the next change of the grid.
  OccupancyBits bits() const { return {resolution_, occupied_.data(), blocks_.data()}; }
  bool Occupied(int x, int y, int z) const;
  double OccupiedFraction() const;

  struct Box {
    std::array<double, 3> min, max;  // field coordinates
  };
  // Smallest box of cells that holds every occupied one but strays: cells that hang together (by faces, edges or
  // corners) with less than `stray` of all the occupied. The whole cube when none is occupied.
  Box OccupiedBox(double stray = 0) const;

  // Everything a checkpoint needs to go on from.
  struct State {
    int resolution = 0;
    std::vector<float> opacity;      // [resolution³] in the bits' order; −1: never measured
    std::vector<uint64_t> seen;      // [resolution³/64] bits, laid out as OccupancyBits::cells
    std::vector<uint64_t> occupied;  // [resolution³/64]
  };
  State GetState() const { return {resolution_, opacity_, seen_, occupied_}; }
  // Throws CorruptError when the sizes do not fit the resolution.
  static OccupancyGrid FromState(State state);

 private:
  // Cells are numbered in storage order, 512·block + 64·(z%8) + 8·(y%8) + x%8: cell i is bit i % 64 of word i / 64.
  std::array<int, 3> CellAt(int64_t index) const;
  int64_t IndexOf(int x, int y, int z) const;
  std::vector<int64_t> ChooseCells(const UpdateOptions& options) const;
  void Measure(const DensitySource& field, const std::vector<int64_t>& cells, const UpdateOptions& options);
  void SetOccupied(float threshold, bool dilate);
  void Dilate();
  void SetBlocks();
  std::vector<uint64_t> WithoutStrays(double stray) const;

  int resolution_;
  std::vector<float> opacity_;
  std::vector<uint64_t> seen_, occupied_;
  std::vector<uint8_t> blocks_;
};

}  // namespace nrff
