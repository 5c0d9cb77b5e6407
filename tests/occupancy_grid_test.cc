// The occupancy grid: what it keeps, what it forgets, what cameras see.

#include "render/occupancy_grid.h"

#include <gtest/gtest.h>

#include <cmath>
#include <random>

#include "pipeline/error.h"
#include "tests/analytic_field.h"

namespace nrff {
namespace {

constexpr int kResolution = 32;

OccupancyGrid::UpdateOptions FullUpdate() {
  return {.step = 0.05,
          .decay = 0.5F,
          .threshold = 0.05F,
          .n_random = 0,
          .n_occupied = 0,
          .seed = 1,
          .counter = 0,
          .dilate = false};
}

// Distances from the centre of the nearest and the farthest point of a cell.
std::pair<double, double> CellRadii(int x, int y, int z) {
  double nearest = 0, farthest = 0;
  for (const int c : {x, y, z}) {
    const double low = 2. * c / kResolution - 1, high = 2. * (c + 1) / kResolution - 1;
    const double inner = low > 0 ? low : high < 0 ? -high : 0, outer = std::max(std::abs(low), std::abs(high));
    nearest += inner * inner;
    farthest += outer * outer;
  }
  return {std::sqrt(nearest), std::sqrt(farthest)};
}

template <typename Visit>
void ForEachCell(Visit&& visit) {
  for (int z = 0; z < kResolution; ++z) {
    for (int y = 0; y < kResolution; ++y) {
      for (int x = 0; x < kResolution; ++x) visit(x, y, z);
    }
  }
}

// Distance at which the ball's opacity over the step falls to the threshold.
double ThresholdRadius(double amplitude, const OccupancyGrid::UpdateOptions& options) {
  const double sigma = -std::log1p(-options.threshold) / options.step;
  return 0.25 * std::sqrt(2 * std::log(amplitude / sigma));
}

TEST(OccupancyGridTest, StartsFullAndRefusesResolutionsThatDoNotFit) {
  EXPECT_EQ(OccupancyGrid(kResolution).OccupiedFraction(), 1);
  for (const int resolution : {0, -8, 12, 2048}) EXPECT_THROW(OccupancyGrid{resolution}, Error) << resolution;
}

TEST(OccupancyGridTest, AFullUpdateKeepsCellsThatReachTheThresholdAndNoOthers) {
  OccupancyGrid grid(kResolution);
  const auto options = FullUpdate();
  grid.Update(GaussianBall(torch::kFloat, 100), options);
  const double radius = ThresholdRadius(100, options);
  int n_inside = 0, n_outside = 0;
  ForEachCell([&](int x, int y, int z) {
    const auto [nearest, farthest] = CellRadii(x, y, z);
    if (farthest < radius) {
      ++n_inside;
      EXPECT_TRUE(grid.Occupied(x, y, z));
    } else if (nearest > radius) {
      ++n_outside;
      EXPECT_FALSE(grid.Occupied(x, y, z));
    }
  });
  EXPECT_GT(n_inside, 1000);
  EXPECT_GT(n_outside, 1000);
  const OccupancyGrid::Box box = grid.OccupiedBox();
  for (int k = 0; k < 3; ++k) {
    EXPECT_NEAR(box.min[k], -radius, 2.01 * 2 / kResolution);
    EXPECT_NEAR(box.max[k], radius, 2.01 * 2 / kResolution);
  }
}

TEST(OccupancyGridTest, AFieldBelowTheThresholdEverywhereKeepsItsDensestCells) {
  OccupancyGrid grid(kResolution);
  grid.Update(GaussianBall(torch::kFloat, 1e-4), FullUpdate());
  EXPECT_TRUE(grid.Occupied(kResolution / 2, kResolution / 2, kResolution / 2));
  EXPECT_LT(grid.OccupiedFraction(), 0.5);
}

TEST(OccupancyGridTest, WhatVanishesDecays) {
  OccupancyGrid grid(kResolution);
  grid.Update(GaussianBall(torch::kFloat, 2), FullUpdate());  // opacity 0.095 in the middle, threshold 0.05
  const int middle = kResolution / 2;
  ASSERT_TRUE(grid.Occupied(middle, middle, middle));
  // Elsewhere something is left, so that the mean does not rule.
  class Corner : public GaussianBall {
   public:
    Corner() : GaussianBall(torch::kFloat, 1e4) {}
    torch::Tensor Density(const torch::Tensor& points) const override { return GaussianBall::Density(points - 0.8); }
  };
  grid.Update(Corner(), FullUpdate());
  EXPECT_FALSE(grid.Occupied(middle, middle, middle));
}

TEST(OccupancyGridTest, PartialUpdatesMeasureWhatTheyAreAskedToAndCanBeRepeated) {
  const GaussianBall ball(torch::kFloat, 100);
  auto options = FullUpdate();
  OccupancyGrid grid(kResolution);
  grid.Update(ball, options);
  ball.n_density = 0;
  options.n_random = 500;
  options.n_occupied = 300;
  options.counter = 1;
  OccupancyGrid twin = OccupancyGrid::FromState(grid.GetState());
  grid.Update(ball, options);
  EXPECT_EQ(ball.n_density, 800);
  twin.Update(ball, options);
  EXPECT_EQ(grid.GetState().opacity, twin.GetState().opacity);
  options.counter = 2;
  twin = OccupancyGrid::FromState(grid.GetState());
  twin.Update(ball, options);
  EXPECT_NE(grid.GetState().opacity, twin.GetState().opacity);
}

TEST(OccupancyGridTest, DilationIsTheMaximumOverThreeCubed) {
  const GaussianBall ball(torch::kFloat, 100);
  auto options = FullUpdate();
  OccupancyGrid plain(kResolution), dilated(kResolution);
  plain.Update(ball, options);
  options.dilate = true;
  dilated.Update(ball, options);
  ForEachCell([&](int x, int y, int z) {
    bool any = false;
    for (int k = 0; k < 27; ++k) {
      const int nx = x + k % 3 - 1, ny = y + k / 3 % 3 - 1, nz = z + k / 9 - 1;
      const bool inside = std::min({nx, ny, nz}) >= 0 && std::max({nx, ny, nz}) < kResolution;
      any |= inside && plain.Occupied(nx, ny, nz);
    }
    ASSERT_EQ(dilated.Occupied(x, y, z), any) << x << ' ' << y << ' ' << z;
  });
}

TEST(OccupancyGridTest, StrayCellsDoNotHoldTheBoxOpen) {
  OccupancyGrid::State state{.resolution = 16,
                             .opacity = std::vector<float>(16 * 16 * 16, 0.F),
                             .seen = std::vector<uint64_t>(64, ~uint64_t{0}),
                             .occupied = std::vector<uint64_t>(64, 0)};
  // A block of 8³ cells at the origin, and two cells that touch by a corner far from it.
  for (int w = 0; w < 8; ++w) state.occupied[w] = ~uint64_t{0};
  const auto set = [&state](int x, int y, int z) {
    const int block = x / 8 + 2 * (y / 8) + 4 * (z / 8);
    state.occupied[block * 8 + z % 8] |= uint64_t{1} << (8 * (y % 8) + x % 8);
  };
  set(12, 13, 14);
  set(13, 14, 15);
  const OccupancyGrid grid = OccupancyGrid::FromState(state);
  EXPECT_EQ(grid.OccupiedBox().max, (std::array<double, 3>{0.75, 0.875, 1}));
  EXPECT_EQ(grid.OccupiedBox(2. / 514).max, (std::array<double, 3>{0.75, 0.875, 1}));  // just enough
  EXPECT_EQ(grid.OccupiedBox(0.01).max, (std::array<double, 3>{0, 0, 0}));
  EXPECT_EQ(grid.OccupiedBox(0.01).min, (std::array<double, 3>{-1, -1, -1}));
}

TEST(OccupancyGridTest, StateRestoresEverythingAndSizesAreChecked) {
  OccupancyGrid grid(kResolution);
  grid.Update(GaussianBall(torch::kFloat, 100), FullUpdate());
  const OccupancyGrid restored = OccupancyGrid::FromState(grid.GetState());
  ForEachCell([&](int x, int y, int z) { ASSERT_EQ(restored.Occupied(x, y, z), grid.Occupied(x, y, z)); });
  const size_t n_blocks = size_t(kResolution / 8) * (kResolution / 8) * (kResolution / 8);
  for (size_t b = 0; b < n_blocks; ++b) ASSERT_EQ(restored.bits().blocks[b], grid.bits().blocks[b]);
  auto state = grid.GetState();
  state.seen.pop_back();
  EXPECT_THROW(OccupancyGrid::FromState(state), Error);
  state = grid.GetState();
  state.resolution = 40;
  EXPECT_THROW(OccupancyGrid::FromState(state), Error);
}

// Three cameras at z = −3, looking along z, side by side.
std::vector<View> RowOfCameras() {
  std::vector<View> views;
  for (int i = 0; i < 3; ++i) {
    View view{.id = "0", .name = "0", .width = 100, .height = 80, .fx = 150, .fy = 150, .cx = 50, .cy = 40};
    view.scene_from_camera = {1, 0, 0, 0.4 * (i - 1), 0, 1, 0, 0, 0, 0, 1, -3, 0, 0, 0, 1};
    views.push_back(view);
  }
  return views;
}

TEST(OccupancyGridTest, EveryPointThatEnoughCamerasSeeIsInASampledCellAndFarFromThemNoneIs) {
  const std::vector<View> views = RowOfCameras();
  for (const bool unbounded : {false, true}) {
    SceneMap map;
    map.unbounded = unbounded;
    for (const int min_views : {1, 2, 3}) {
      OccupancyGrid grid(kResolution);
      grid.MarkSeen(views, map, 0.05, min_views);
      std::mt19937 random(1);
      std::uniform_real_distribution<double> uniform(-1, 1);
      int n_seen = 0;
      for (int i = 0; i < 20000; ++i) {
        const double field[3] = {uniform(random), uniform(random), uniform(random)};
        double scene[3];
        map.ToScene(field, scene);
        int n_views = 0;
        for (const View& view : views) {
          const double z = scene[2] + 3, x = view.fx * (scene[0] - view.scene_from_camera[3]) / z + view.cx;
          const double y = view.fy * scene[1] / z + view.cy;
          n_views += z > 0.05 && x >= 0 && x <= view.width && y >= 0 && y <= view.height ? 1 : 0;
        }
        const auto cell = [](double f) {
          return std::min(static_cast<int>((f + 1) * 0.5 * kResolution), kResolution - 1);
        };
        if (n_views >= min_views) {
          ++n_seen;
          ASSERT_TRUE(grid.Occupied(cell(field[0]), cell(field[1]), cell(field[2])));
        }
      }
      EXPECT_GT(n_seen, 500);
      const double seen_fraction = n_seen / 20000.;
      // More than the points' share, since any part of a cell counts, but not everything.
      EXPECT_GE(grid.OccupiedFraction(), seen_fraction - 0.02);
      EXPECT_LE(grid.OccupiedFraction(), seen_fraction + 0.25);
    }
  }
}

TEST(OccupancyGridTest, UnseenCellsStayEmptyWhateverTheFieldSays) {
  OccupancyGrid grid(kResolution);
  grid.MarkSeen(RowOfCameras(), SceneMap{}, 0.05, 1);
  const double seen = grid.OccupiedFraction();
  ASSERT_LT(seen, 0.9);
  grid.Update(GaussianBall(torch::kFloat, 1e30), FullUpdate());
  EXPECT_LE(grid.OccupiedFraction(), seen);
  EXPECT_GT(grid.OccupiedFraction(), 0.5 * seen);
}

}  // namespace
}  // namespace nrff
