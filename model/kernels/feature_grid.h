// Multiscale tensor decomposition (MTD): a field over [-1, 1]³ as sums of plane ⊙ line products on several grids.
//
//   level l:  G_l(x, y, z) = { P_yz(y, z) ⊙ L_x(x),  P_xz(x, z) ⊙ L_y(y),  P_xy(x, y) ⊙ L_z(z) }     C channels each
//
// [Han23] Eq. 4–6. Planes and lines are interpolated (bi)linearly between nodes that include both ends of [-1, 1]
// (align_corners). Coordinates outside [-1, 1] take the value at the nearest end, NaN that at −1.
//
// Two read-outs: the appearance grid concatenates all products, the density grid sums all of them into one number.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

namespace nrff {

// Product p multiplies the plane over (column axis, row axis) with the line over the third; x = 0, y = 1, z = 2.
// In the order in which features are concatenated.
struct GridProduct {
  int column_axis, row_axis, line_axis;
  const char* plane_name;
  const char* line_name;
};
inline constexpr std::array<GridProduct, 3> kGridProducts{{
    {1, 2, 0, "plane_yz", "line_x"},
    {0, 2, 1, "plane_xz", "line_y"},
    {0, 1, 2, "plane_xy", "line_z"},
}};

// Where the grids lie in one flat parameter buffer. Channels last: plane [row][column][C], line [node][C].
struct GridLayout {
  struct Level {
    int resolution;                        // nodes along every axis, ≥ 2
    std::array<int64_t, 3> plane_offsets;  // elements, by product
    std::array<int64_t, 3> line_offsets;
  };
  int n_channels = 0;  // C of an entry of `levels`, 2 or 4; a level of more channels is several entries of 4
  std::vector<Level> levels;
  int64_t n_parameters = 0;

  int n_products() const { return int(levels.size()) * 3; }
  int n_features() const { return n_products() * n_channels; }
};

// Resolutions ⌊base · b^l⌋ with b such that the last level has `max_resolution`; a single level has base = max. Of
// these levels the `n_left_out` finest are then left out. Throws std::invalid_argument unless n_levels > n_left_out ≥
// 0, 2 ≤ base ≤ max and n_channels, a level's, is 2 or a multiple of 4.
GridLayout MakeGridLayout(int n_levels, int base_resolution, int max_resolution, int n_channels, int n_left_out = 0);

// points [n, 3]; parameters [layout.n_parameters]; Scalar is float or double. One thread's work: callers split points
// between threads (forward) or products (backward).

// features [layout.n_products()][n][C], overwritten: C values of product p of level l at row 3·l + p.
template <typename Scalar>
void GridConcatForward(const GridLayout& layout, const Scalar* parameters, const Scalar* points, int64_t n,
                       Scalar* features);

// feature [n]: sum over levels, products and channels. Overwritten.
template <typename Scalar>
void GridSumForward(const GridLayout& layout, const Scalar* parameters, const Scalar* points, int64_t n,
                    Scalar* feature);

// Of product `product` = 3·level + p alone: accumulates into its plane's and line's part of d_parameters, in the order
// of the points. d_features [n][C] of that product; d_feature [n].
template <typename Scalar>
void GridConcatBackward(const GridLayout& layout, int product, const Scalar* parameters, const Scalar* points,
                        int64_t n, const Scalar* d_features, Scalar* d_parameters);
template <typename Scalar>
void GridSumBackward(const GridLayout& layout, int product, const Scalar* parameters, const Scalar* points, int64_t n,
                     const Scalar* d_feature, Scalar* d_parameters);

}  // namespace nrff
