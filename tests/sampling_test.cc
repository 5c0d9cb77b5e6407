// Camera rays, sampling along rays and random numbers against first principles and brute force. No torch.

#include "render/kernels/sampling.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <random>
#include <vector>

#include "render/kernels/camera_rays.h"
#include "render/kernels/random.h"

namespace nrff {
namespace {

struct TestGrid {
  int resolution;
  std::vector<uint64_t> cells;
  std::vector<uint8_t> blocks;

  // Each block is empty with probability ½, else a cell is occupied with probability ½.
  static TestGrid Random(int resolution, unsigned seed) {
    TestGrid grid = Full(resolution);
    std::mt19937_64 random(seed);
    for (size_t b = 0; b < grid.blocks.size(); ++b) {
      const bool empty = random() % 2 == 0;
      grid.blocks[b] = empty ? 0 : 1;
      for (int w = 0; w < 8; ++w) grid.cells[8 * b + w] = empty ? 0 : random();
    }
    return grid;
  }
  static TestGrid Full(int resolution) {
    const size_t n_cells = size_t(resolution) * resolution * resolution;
    return {resolution, std::vector<uint64_t>(n_cells / 64, ~uint64_t{0}), std::vector<uint8_t>(n_cells / 512, 1)};
  }
  OccupancyBits bits() const { return {resolution, cells.data(), blocks.data()}; }
};

template <typename Scalar>
struct TestRays {
  std::vector<Scalar> origins, directions;
  int64_t size() const { return static_cast<int64_t>(origins.size()) / 3; }
  void Add(std::array<double, 3> o, std::array<double, 3> d) {
    const double norm = std::hypot(d[0], d[1], d[2]);
    for (int k = 0; k < 3; ++k) {
      origins.push_back(static_cast<Scalar>(o[k]));
      directions.push_back(static_cast<Scalar>(d[k] / norm));
    }
  }
};

// From outside towards the box, from within, along axes and in coordinate planes.
template <typename Scalar>
TestRays<Scalar> MakeRays(int n, unsigned seed) {
  std::mt19937 random(seed);
  std::normal_distribution<double> normal;
  TestRays<Scalar> rays;
  for (int r = 0; r < n; ++r) {
    std::array<double, 3> o{normal(random), normal(random), normal(random)}, d;
    const double reach = r % 2 == 0 ? 3 : 0.5;
    const double norm = std::hypot(o[0], o[1], o[2]);
    for (int k = 0; k < 3; ++k) {
      o[k] *= reach / norm;
      d[k] = 0.6 * normal(random) - (r % 2 == 0 ? o[k] : 0);
      if ((r / 8 >> k & 1) != 0) d[k] = 0;
    }
    if (d[0] == 0 && d[1] == 0 && d[2] == 0) d[r % 3] = 1;
    rays.Add(o, d);
  }
  return rays;
}

template <typename Scalar>
struct Marched {
  std::vector<int64_t> offsets, ray_index;
  std::vector<Scalar> t, delta, points;
};

template <typename Scalar>
MarchArgs<Scalar> MakeArgs(const TestRays<Scalar>& rays, const TestGrid& grid, const SceneMap& map, double step) {
  MarchArgs<Scalar> args;
  args.n_rays = rays.size();
  args.origins = rays.origins.data();
  args.directions = rays.directions.data();
  args.occupancy = grid.bits();
  args.map = map;
  args.step = step;
  args.near = 0.05;
  args.far = 20;
  return args;
}

template <typename Scalar>
Marched<Scalar> RunMarch(const MarchArgs<Scalar>& args) {
  Marched<Scalar> out;
  out.offsets.assign(args.n_rays + 1, -1);
  const int64_t n = CountSamplesCpu(args, out.offsets.data());
  out.ray_index.assign(n, -1);
  out.t.assign(n, -1);
  out.delta.assign(n, -1);
  out.points.assign(3 * n, -9);
  FillSamplesCpu(args, out.offsets.data(),
                 SampleArrays<Scalar>{out.t.data(), out.delta.data(), out.points.data(), out.ray_index.data()});
  return out;
}

SceneMap OffCenterMap(bool unbounded) { return SceneMap::FromBox({-0.9, -1.2, -0.7}, {1.1, 0.8, 0.9}, unbounded); }

// Cell coordinate of the field coordinate, and whether it is too near a cell's face for rounding not to matter.
struct BruteCell {
  int cell[3];
  bool ambiguous = false;
};
BruteCell LocateCell(const double field[3], int resolution) {
  BruteCell out{};
  for (int k = 0; k < 3; ++k) {
    const double g = (field[k] + 1) * 0.5 * resolution;
    out.cell[k] = std::clamp(static_cast<int>(std::floor(g)), 0, resolution - 1);
    out.ambiguous |= std::abs(g - std::round(g)) < 1e-9;
  }
  return out;
}

TEST(SamplingTest, EveryLatticePositionInAnOccupiedCellIsSampledAndNoOther) {
  const TestGrid grid = TestGrid::Random(32, 1);
  const SceneMap map = OffCenterMap(false);
  const auto rays = MakeRays<double>(512, 2);
  auto args = MakeArgs(rays, grid, map, 0.013);
  args.jitter = true;
  args.jitter_seed = 3;
  const auto out = RunMarch(args);
  EXPECT_GT(out.t.size(), 5000U);
  int64_t n_checked = 0;
  for (int64_t r = 0; r < rays.size(); ++r) {
    const double *o = &rays.origins[3 * r], *d = &rays.directions[3 * r];
    // The lattice, from first principles: intersection with the box by scanning its six faces.
    double enter = args.near, leave = args.far;
    for (int k = 0; k < 3; ++k) {
      const double low = map.center[k] - map.half_extent[k], high = map.center[k] + map.half_extent[k];
      if (d[k] == 0) {
        if (o[k] < low || o[k] > high) leave = -1;
      } else {
        enter = std::max(enter, std::min((low - o[k]) / d[k], (high - o[k]) / d[k]));
        leave = std::min(leave, std::max((low - o[k]) / d[k], (high - o[k]) / d[k]));
      }
    }
    int64_t next = out.offsets[r];
    const double t0 = enter + args.step * Uniform(args.jitter_seed, args.jitter_stream, r);
    for (int64_t i = 0; t0 + i * args.step <= leave; ++i) {
      const double t = t0 + i * args.step;
      double scene[3], field[3];
      for (int k = 0; k < 3; ++k) scene[k] = o[k] + t * d[k];
      map.ToField(scene, field);
      const BruteCell where = LocateCell(field, grid.resolution);
      const OccupancyBits bits = grid.bits();
      const bool occupied = bits.CellOccupied(bits.BlockOf(where.cell[0], where.cell[1], where.cell[2]), where.cell[0],
                                              where.cell[1], where.cell[2]);
      const bool sampled = next < out.offsets[r + 1] && std::abs(out.t[next] - t) < 1e-9;
      if (!where.ambiguous) {
        ++n_checked;
        ASSERT_EQ(sampled, occupied) << "ray " << r << " position " << i;
      }
      if (sampled) {
        for (int k = 0; k < 3; ++k) ASSERT_NEAR(out.points[3 * next + k], field[k], 1e-12);
        ASSERT_EQ(out.ray_index[next], r);
        ASSERT_EQ(out.delta[next], args.step);
        ++next;
      }
    }
    ASSERT_EQ(next, out.offsets[r + 1]);
  }
  EXPECT_GT(n_checked, 20000);
}

template <typename Scalar>
class SamplingInBothTypesTest : public testing::Test {};
using Scalars = testing::Types<float, double>;
TYPED_TEST_SUITE(SamplingInBothTypesTest, Scalars);

TYPED_TEST(SamplingInBothTypesTest, JumpingOverEmptyBlocksChangesNoSample) {
  for (const bool unbounded : {false, true}) {
    TestGrid grid = TestGrid::Random(64, 4);
    const auto rays = MakeRays<TypeParam>(1000, 5);
    const auto with_jumps = RunMarch(MakeArgs(rays, grid, OffCenterMap(unbounded), 0.007));
    grid.blocks.assign(grid.blocks.size(), 1);  // no block says it is empty: no jump
    const auto without = RunMarch(MakeArgs(rays, grid, OffCenterMap(unbounded), 0.007));
    EXPECT_EQ(with_jumps.offsets, without.offsets);
    EXPECT_EQ(with_jumps.t, without.t);
    EXPECT_EQ(with_jumps.points, without.points);
    EXPECT_GT(with_jumps.t.size(), 10000U);
  }
}

TEST(SamplingTest, UnboundedStepsAreTheStepInContractedLengthAndReachFar) {
  const TestGrid grid = TestGrid::Full(32);
  const SceneMap map = OffCenterMap(true);
  const auto rays = MakeRays<double>(200, 6);
  const auto args = MakeArgs(rays, grid, map, 0.016);
  const auto out = RunMarch(args);
  for (int64_t r = 0; r < rays.size(); ++r) {
    const double *o = &rays.origins[3 * r], *d = &rays.directions[3 * r];
    double speed = 0;
    for (int k = 0; k < 3; ++k) speed += d[k] * d[k] / (map.half_extent[k] * map.half_extent[k]);
    const int64_t begin = out.offsets[r], end = out.offsets[r + 1];
    ASSERT_EQ(out.t[begin], args.near);
    for (int64_t i = begin; i < end; ++i) {
      double scene[3], field[3], m = 1;
      for (int k = 0; k < 3; ++k) {
        scene[k] = o[k] + out.t[i] * d[k];
        m = std::max(m, std::abs(scene[k] - map.center[k]) / map.half_extent[k]);
      }
      map.ToField(scene, field);
      for (int k = 0; k < 3; ++k) {
        ASSERT_NEAR(out.points[3 * i + k], field[k], 1e-12);
        ASSERT_LT(std::abs(field[k]), 1);
      }
      const double step = args.step * m * m / std::sqrt(speed);
      ASSERT_NEAR(map.StepAt(scene, d, args.step), step, 1e-12 * step);
      const double next = i + 1 < end ? out.t[i + 1] : args.far;
      ASSERT_LE(next - out.t[i], step * (1 + 1e-9));
      if (i + 1 < end) {
        ASSERT_NEAR(next - out.t[i], step, 1e-9 * step);
      }
    }
  }
}

TEST(SamplingTest, RaysBesideOrBehindTheBoxHaveNoSamplesAndParallelOnesAreExact) {
  TestRays<float> rays;
  rays.Add({0, 0, -3}, {0, 0, 1});     // through the middle
  rays.Add({0, 1.5, -3}, {0, 0, 1});   // parallel, beside
  rays.Add({0, 0, 3}, {0, 0, 1});      // behind the origin
  rays.Add({1, 1, -3}, {0, 0, 1});     // along an edge: belongs to the box
  rays.Add({0, 0, 0}, {-1, 0, -0.0});  // from within
  const TestGrid grid = TestGrid::Full(8);
  auto args = MakeArgs(rays, grid, SceneMap{}, 0.25);
  args.near = 0;
  const auto out = RunMarch(args);
  EXPECT_THAT(out.offsets, testing::ElementsAre(0, 9, 9, 9, 18, 23));
  EXPECT_EQ(out.t[0], 2);
  EXPECT_EQ(out.t[8], 4);
}

TEST(SamplingTest, JitterMovesTheLatticeByLessThanAStepAndDependsOnSeedStreamAndRayOnly) {
  const TestGrid grid = TestGrid::Full(16);
  const auto rays = MakeRays<double>(64, 7);
  auto args = MakeArgs(rays, grid, OffCenterMap(false), 0.02);
  const auto plain = RunMarch(args);
  args.jitter = true;
  args.jitter_seed = 11;
  args.jitter_stream = StreamAt(RandomStream::kRayJitter, 5);
  const auto first = RunMarch(args), again = RunMarch(args);
  EXPECT_EQ(first.t, again.t);
  args.jitter_stream = StreamAt(RandomStream::kRayJitter, 6);
  EXPECT_NE(RunMarch(args).t, first.t);
  for (int64_t r = 0; r < rays.size(); ++r) {
    if (first.offsets[r] == first.offsets[r + 1]) continue;
    const double shift = (first.t[first.offsets[r]] - plain.t[plain.offsets[r]]) / args.step;
    EXPECT_NEAR(shift, Uniform(11, StreamAt(RandomStream::kRayJitter, 5), r), 1e-9);
  }
}

TEST(SceneMapTest, FieldToSceneUndoesSceneToField) {
  std::mt19937 random(8);
  std::normal_distribution<double> normal(0, 3);
  for (const bool unbounded : {false, true}) {
    const SceneMap map = OffCenterMap(unbounded);
    for (int i = 0; i < 1000; ++i) {
      const double scene[3] = {normal(random), normal(random), normal(random)};
      double field[3], back[3];
      map.ToField(scene, field);
      map.ToScene(field, back);
      for (int k = 0; k < 3; ++k) EXPECT_NEAR(back[k], scene[k], 1e-11 * (1 + std::abs(scene[k])));
    }
  }
}

TEST(CameraRaysTest, APointOnThePixelsRayProjectsToThePixelsCentre) {
  PinholeCamera camera{500, 480, 320.5, 239.25, {}};
  const double c = std::cos(0.7), s = std::sin(0.7);
  const double pose[12] = {c, -s, 0, 1, s, c, 0, -2, 0, 0, 1, 0.5};
  std::copy_n(pose, 12, camera.scene_from_camera);
  const std::vector<PinholeCamera> cameras{PinholeCamera{}, camera};
  const std::vector<int32_t> pixels{1, 0, 0, 1, 639, 479, 1, 320, 100};
  std::vector<double> origins(9), directions(9);
  CameraRaysCpu<double>({3, cameras.data(), pixels.data(), origins.data(), directions.data()});
  for (int r = 0; r < 3; ++r) {
    const double* d = &directions[3 * r];
    EXPECT_NEAR(std::hypot(d[0], d[1], d[2]), 1, 1e-15);
    double local[3];  // camera_from_scene · direction
    for (int k = 0; k < 3; ++k) {
      EXPECT_EQ(origins[3 * r + k], pose[4 * k + 3]);
      local[k] = pose[k] * d[0] + pose[4 + k] * d[1] + pose[8 + k] * d[2];
    }
    EXPECT_NEAR(camera.fx * local[0] / local[2] + camera.cx, pixels[3 * r + 1] + 0.5, 1e-10);
    EXPECT_NEAR(camera.fy * local[1] / local[2] + camera.cy, pixels[3 * r + 2] + 0.5, 1e-10);
    EXPECT_GT(local[2], 0);
  }
}

TEST(RandomTest, UniformHasTheMomentsAndNoCorrelationBetweenStreams) {
  constexpr int kDraws = 200000;
  const uint64_t a = StreamAt(RandomStream::kBatch, 0), b = StreamAt(RandomStream::kBatch, 1);
  double mean = 0, square = 0, product = 0;
  for (int i = 0; i < kDraws; ++i) {
    const double x = Uniform(1, a, i), y = Uniform(1, b, i);
    ASSERT_GE(x, 0);
    ASSERT_LT(x, 1);
    mean += x / kDraws;
    square += (x - 0.5) * (x - 0.5) / kDraws;
    product += (x - 0.5) * (y - 0.5) / kDraws;
  }
  const double sigma = 1 / std::sqrt(12. * kDraws);  // of the mean
  EXPECT_NEAR(mean, 0.5, 5 * sigma);
  EXPECT_NEAR(square, 1 / 12., 5 * sigma);
  EXPECT_NEAR(product, 0, 5 * sigma);
}

TEST(RandomTest, UniformBelowIsEvenOverSmallRanges) {
  std::vector<int> counts(7, 0);
  for (int i = 0; i < 70000; ++i) ++counts[UniformBelow(7, 2, 3, i)];
  for (const int n : counts) EXPECT_NEAR(n, 10000, 5 * std::sqrt(10000.));
}

}  // namespace
}  // namespace nrff
