// Volume rendering through torch: closed forms, autograd against finite differences, batches against single rays, the
// reference's samples and weights, and the view writer.

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <cstdlib>
#include <cstring>
#include <random>

#include "model/safetensors.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"
#include "render/image_renderer.h"
#include "render/kernels/compositing.h"
#include "render/kernels/sampling.h"
#include "render/ray_block.h"
#include "render/view_writer.h"
#include "render/volume_renderer.h"
#include "tests/analytic_field.h"
#include "tests/temporary_directory.h"

namespace nrff {
namespace {

using torch::Tensor;

// Rays along z at the given impact parameters, from z = −2.
Rays ParallelRays(const std::vector<double>& offsets, torch::Dtype type) {
  Rays rays{at::zeros({static_cast<int64_t>(offsets.size()), 3}, type),
            at::zeros({static_cast<int64_t>(offsets.size()), 3}, type)};
  for (size_t r = 0; r < offsets.size(); ++r) rays.origins[r][0] = offsets[r];
  rays.origins.select(1, 2).fill_(-2);
  rays.directions.select(1, 2).fill_(1);
  return rays;
}

RenderOptions Exact(double step) {
  return {.step = step,
          .near = 0,
          .far = 10,
          .weight_threshold = 0,
          .stop_transmittance = 0,
          .background = 0.25,
          .jitter = {}};
}

TEST(RenderRaysTest, OpacityOfAGaussianBallIsItsClosedForm) {
  const GaussianBall ball(torch::kDouble);
  const std::vector<double> offsets{0, 0.1, 0.3, 0.6};
  const RenderResult result =
      RenderRays(ball, OccupancyGrid(32), SceneMap{}, ParallelRays(offsets, torch::kDouble), Exact(0.01));
  for (size_t r = 0; r < offsets.size(); ++r) {
    const double s = 0.25, b = offsets[r];
    // The box cuts the Gaussian at z = ±1, four widths out.
    const double thickness =
        8 * s * std::sqrt(2 * M_PI) * std::exp(-b * b / (2 * s * s)) * std::erf(1 / (s * std::sqrt(2.)));
    // Riemann sums of a smooth function that vanishes at the ends converge faster than any power; the ends leave
    // step·σ(±1).
    const double tolerance = 0.01 * 8 * std::exp(-8.);
    EXPECT_NEAR(result.opacity[r].item<double>(), -std::expm1(-thickness), tolerance);
  }
}

// Colour and depth against a fine quadrature of ∫ T σ c dt. The error falls with the square of the step, but for the
// half interval at either end of the box, where σ is 8·e⁻⁸.
TEST(RenderRaysTest, ColourAndDepthConvergeToTheIntegral) {
  const GaussianBall ball(torch::kDouble);
  const auto sigma = [](double z) { return 8 * std::exp(-z * z / (2 * 0.0625)); };
  double color = 0, depth = 0, transmittance = 1;
  constexpr int kSteps = 200000;
  for (int i = 0; i < kSteps; ++i) {
    const double z = -1 + 2. * (i + 0.5) / kSteps, tau = sigma(z) * 2. / kSteps;
    const double w = transmittance * -std::expm1(-tau);
    color += w * (0.5 + 0.5 * std::sin(3 * z + 2));
    depth += w * (z + 2);
    transmittance *= std::exp(-tau);
  }
  color += transmittance * 0.25;
  for (const double step : {0.16, 0.08, 0.04, 0.01}) {
    const auto result = RenderRays(ball, OccupancyGrid(16), SceneMap{}, ParallelRays({0}, torch::kDouble), Exact(step));
    const double tolerance = 0.05 * step * step + step * 8 * std::exp(-8.);
    EXPECT_NEAR(result.rgb[0][2].item<double>(), color, tolerance) << step;
    EXPECT_NEAR(result.depth[0].item<double>(), depth, 3 * tolerance) << step;
  }
}

// From outside, towards the ball or past it.
Rays RandomRays(int64_t n, torch::Dtype type) {
  std::mt19937 random(1);
  std::normal_distribution<double> normal;
  Rays rays{at::empty({n, 3}, torch::kDouble), at::empty({n, 3}, torch::kDouble)};
  for (Tensor* tensor : {&rays.origins, &rays.directions}) {
    auto* data = tensor->mutable_data_ptr<double>();
    for (int64_t i = 0; i < 3 * n; ++i) data[i] = normal(random);
  }
  rays.origins = 2 * rays.origins / rays.origins.norm(2, 1, true);
  rays.directions = 0.2 * rays.directions - rays.origins;
  rays.directions = rays.directions / rays.directions.norm(2, 1, true);
  return {rays.origins.to(type), rays.directions.to(type)};
}

TEST(RenderRaysTest, GradientsMatchFiniteDifferences) {
  GaussianBall ball(torch::kDouble);
  const Rays rays = RandomRays(20, torch::kDouble);
  const OccupancyGrid grid(16);
  const Tensor g_rgb = at::sin(at::arange(60, torch::kDouble)).view({20, 3});
  const Tensor g_normal = at::cos(at::arange(60, torch::kDouble)).view({20, 3});
  const Tensor g_opacity = at::sin(at::arange(20, torch::kDouble) * 2);
  const auto loss = [&] {
    const RenderResult result = RenderRays(ball, grid, SceneMap{}, rays, Exact(0.05));
    return (result.rgb * g_rgb).sum() + (result.normal * g_normal).sum() + (result.opacity * g_opacity).sum() +
           result.shaded_weights.square().sum();
  };
  for (Tensor* parameter : {&ball.amplitude, &ball.width, &ball.frequency}) {
    parameter->set_requires_grad(true);
    loss().backward();
    const double gradient = parameter->grad().item<double>();
    parameter->set_requires_grad(false);
    const double h = 1e-5;
    parameter->add_(h);
    const double up = loss().item<double>();
    parameter->sub_(2 * h);
    const double down = loss().item<double>();
    parameter->add_(h);
    EXPECT_NEAR(gradient, (up - down) / (2 * h), 1e-7 * (1 + std::abs(gradient)));
    EXPECT_GT(std::abs(gradient), 1e-3);
  }
}

TEST(RenderRaysTest, ABatchIsItsRaysOneByOne) {
  const GaussianBall ball(torch::kFloat);
  const Rays rays = RandomRays(50, torch::kFloat);
  const OccupancyGrid grid(16);
  RenderOptions options = Exact(0.03);
  options.weight_threshold = 1e-3;
  options.stop_transmittance = 1e-2;
  const RenderResult batch = RenderRays(ball, grid, SceneMap{}, rays, options);
  int64_t n_samples = 0;
  for (int64_t r = 0; r < 50; ++r) {
    const Rays one{rays.origins.slice(0, r, r + 1), rays.directions.slice(0, r, r + 1)};
    const RenderResult single = RenderRays(ball, grid, SceneMap{}, one, options);
    n_samples += single.n_samples;
    EXPECT_TRUE(at::allclose(single.rgb[0], batch.rgb[r], 1e-5, 1e-6));
    EXPECT_TRUE(at::allclose(single.normal[0], batch.normal[r], 1e-5, 1e-6));
    EXPECT_TRUE(at::allclose(single.depth[0], batch.depth[r], 1e-5, 1e-6));
  }
  EXPECT_EQ(n_samples, batch.n_samples);
}

TEST(RenderRaysTest, RaysThatMeetNothingAreBackgroundAndDoNotCallTheField) {
  const GaussianBall ball(torch::kFloat);
  Rays rays = ParallelRays({5, 6}, torch::kFloat);
  const RenderResult result = RenderRays(ball, OccupancyGrid(8), SceneMap{}, rays, Exact(0.01));
  EXPECT_EQ(ball.n_density + ball.n_shade, 0);
  EXPECT_TRUE(at::equal(result.rgb, at::full({2, 3}, 0.25)));
  EXPECT_TRUE(at::equal(result.opacity, at::zeros({2})));
  RenderRays(GaussianBall(torch::kFloat, 0), OccupancyGrid(8), SceneMap{}, ParallelRays({0}, torch::kFloat),
             Exact(0.1));
  const GaussianBall empty(torch::kFloat, 0);  // samples, but none with weight
  RenderRays(empty, OccupancyGrid(8), SceneMap{}, ParallelRays({0}, torch::kFloat), Exact(0.1));
  EXPECT_GT(empty.smallest_call, 0);
  EXPECT_EQ(empty.n_shade, 0);
}

TEST(RenderRaysTest, TheWeightThresholdCostsAtMostTheWeightsLeftOut) {
  const GaussianBall ball(torch::kDouble);
  const Rays rays = RandomRays(100, torch::kDouble);
  RenderOptions options = Exact(0.02);
  const RenderResult all = RenderRays(ball, OccupancyGrid(8), SceneMap{}, rays, options);
  options.weight_threshold = options.stop_transmittance = 1e-2;
  const RenderResult few = RenderRays(ball, OccupancyGrid(8), SceneMap{}, rays, options);
  EXPECT_LT(few.n_shaded, all.n_shaded / 2);
  EXPECT_TRUE(few.shaded_weights.gt(1e-2).all().item<bool>());
  const double left_out = (all.shaded_weights.sum() - few.shaded_weights.sum()).item<double>();
  const double difference = (all.rgb - few.rgb).abs().sum().item<double>();
  EXPECT_LE(difference, 3 * left_out);
  EXPECT_GT(difference, 0);
}

// Rays from all around through the ball.
Rays RaysThroughTheBall(int64_t n) {
  at::manual_seed(4);
  const Tensor from = at::randn({n, 3}, torch::kFloat), towards = 0.4 * at::randn({n, 3}, torch::kFloat);
  const Tensor origins = 2 * from / from.norm(2, 1, true), directions = towards - origins;
  return {origins.contiguous(), (directions / directions.norm(2, 1, true)).contiguous()};
}

class RayBlockTest : public ::testing::TestWithParam<std::pair<bool, double>> {};

TEST_P(RayBlockTest, HasTheSamplesAndWeightsOfRaysTracedWholeCutAtTheStop) {
  const auto [unbounded, stop] = GetParam();
  const GaussianBall ball(torch::kFloat);
  OccupancyGrid occupancy(32);
  occupancy.Update(ball, {.step = 0.05, .threshold = 0.01F});
  SceneMap map;
  map.unbounded = unbounded;
  RenderOptions options = Exact(0.02);
  options.stop_transmittance = stop;
  options.jitter = {3, 9};
  const Rays rays = RaysThroughTheBall(RayBlock::kRays);
  const Samples samples = MarchRays(occupancy, map, rays, options);
  const Visibility visibility = MeasureVisibility(ball, samples, stop);

  RayBlock block;
  const MarchArgs<float> args{.n_rays = RayBlock::kRays,
                              .origins = rays.origins.const_data_ptr<float>(),
                              .directions = rays.directions.const_data_ptr<float>(),
                              .occupancy = occupancy.bits(),
                              .map = map,
                              .step = options.step,
                              .near = options.near,
                              .far = options.far,
                              .jitter = true,
                              .jitter_seed = 3,
                              .jitter_stream = StreamAt(RandomStream::kRayJitter, 9)};
  for (int repeat = 0; repeat < 2; ++repeat) {  // what a block held before must not matter
    block.Trace(ball, args, 0, RayBlock::kRays, static_cast<float>(stop));
  }
  const auto* offsets = samples.ray_offsets.const_data_ptr<int64_t>();
  int64_t n_cut = 0;
  for (int64_t r = 0; r < RayBlock::kRays; ++r) {
    const int64_t n = block.offsets[r + 1] - block.offsets[r], n_whole = offsets[r + 1] - offsets[r];
    ASSERT_LE(n, n_whole);
    n_cut += n_whole - n;
    for (int64_t i = 0; i < n_whole; ++i) {
      const auto weight = visibility.weights[offsets[r] + i].item<float>();
      if (i >= n) {
        ASSERT_EQ(weight, 0);
        continue;
      }
      ASSERT_EQ(block.t[block.offsets[r] + i], samples.t[offsets[r] + i].item<float>());
      // The ball's exponential may differ in the last bit between batches of different sizes.
      ASSERT_NEAR(block.weights[block.offsets[r] + i], weight, 1e-6);
    }
    ASSERT_NEAR(block.transmittance[r], visibility.transmittance[r].item<float>(), 1e-6);
  }
  EXPECT_GT(block.offsets.back(), 500);
  EXPECT_EQ(n_cut > 0, stop > 0);
  EXPECT_LE(block.n_evaluated, samples.t.numel());
}

INSTANTIATE_TEST_SUITE_P(Stops, RayBlockTest,
                         ::testing::Values(std::pair{false, 0.}, std::pair{false, 0.05}, std::pair{true, 0.05}));

TEST(RenderImageTest, IsTheRaysOfItsPixels) {
  const GaussianBall ball(torch::kFloat);
  OccupancyGrid occupancy(32);
  occupancy.Update(ball, {.step = 0.05, .threshold = 0.01F});
  View view;
  view.width = 37;  // no multiple of the tiles
  view.height = 21;
  view.fx = view.fy = 40;
  view.cx = 18;
  view.cy = 11;
  view.scene_from_camera = {1, 0, 0, 0.1, 0, 1, 0, 0, 0, 0, 1, -2, 0, 0, 0, 1};
  RenderOptions options = Exact(0.02);
  options.weight_threshold = options.stop_transmittance = 1e-3;
  std::vector<int32_t> pixels;
  for (int y = 0; y < view.height; ++y) {
    for (int x = 0; x < view.width; ++x) pixels.insert(pixels.end(), {0, x, y});
  }
  const Rays rays = RaysThroughPixels({view}, at::tensor(pixels, at::kInt).view({-1, 3}), torch::kFloat);
  const RenderResult expected = RenderRays(ball, occupancy, SceneMap{}, rays, options);
  int64_t done = 0;
  const RenderedImage image =
      RenderImage(ball, occupancy, SceneMap{}, view, options, [&done](int64_t n_rays) { done = n_rays; });
  EXPECT_EQ(done, 37 * 21);
  EXPECT_EQ(image.n_shaded, expected.n_shaded);
  for (int64_t i = 0; i < 37 * 21; ++i) {
    for (int c = 0; c < 3; ++c) ASSERT_NEAR(image.rgb[3 * i + c], expected.rgb[i][c].item<float>(), 1e-5) << i;
    ASSERT_NEAR(image.opacity[i], expected.opacity[i].item<float>(), 1e-5) << i;
  }
  options.colour_tolerance = 0.02;
  const RenderedImage fewer = RenderImage(ball, occupancy, SceneMap{}, view, options);
  EXPECT_LT(fewer.n_shaded, image.n_shaded);
  float most = 0;
  for (size_t i = 0; i < image.rgb.size(); ++i) most = std::max(most, std::abs(fewer.rgb[i] - image.rgb[i]));
  EXPECT_GT(most, 0);
  EXPECT_LE(most, 0.02 + 1e-5);
  // Rays end where less than half the tolerance is left of the light; until then nothing differs. The ball's
  // exponential may differ in the last bit between batches of different sizes.
  EXPECT_LT(fewer.n_samples, image.n_samples);
  for (size_t i = 0; i < image.opacity.size(); ++i) {
    const float missed = image.opacity[i] - fewer.opacity[i];
    ASSERT_GE(missed, -1e-6F);
    ASSERT_LE(missed, fewer.opacity[i] < 1 - 0.01F ? 1e-6F : 0.01F);
  }
  // Fewer points than samples, and more of them for a smaller error.
  EXPECT_LT(10 * fewer.n_shaded, 4 * image.n_shaded);
  options.colour_tolerance = 1e-6;
  const RenderedImage closer = RenderImage(ball, occupancy, SceneMap{}, view, options);
  EXPECT_GT(closer.n_shaded, fewer.n_shaded);
  const auto mean_error = [&image](const RenderedImage& other) {
    double sum = 0;
    for (size_t i = 0; i < image.rgb.size(); ++i) sum += std::abs(double(other.rgb[i]) - image.rgb[i]);
    return sum / double(image.rgb.size());
  };
  EXPECT_LT(mean_error(closer), 1e-2 * mean_error(fewer));
}

TEST(RenderRaysTest, UnusableOptionsAreInputErrors) {
  const GaussianBall ball(torch::kFloat);
  const Rays rays = ParallelRays({0}, torch::kFloat);
  for (const RenderOptions& options :
       {Exact(0), Exact(-1), Exact(std::nan("")), RenderOptions{.near = 2, .far = 1, .jitter = {}},
        RenderOptions{.far = INFINITY, .jitter = {}}}) {
    EXPECT_THROW(RenderRays(ball, OccupancyGrid(8), SceneMap{}, rays, options), Error);
  }
}

// ------------------------------------------------------------------------------------------------------- reference

class ReferenceTest : public testing::Test {
 protected:
  void SetUp() override {
    const char* given = std::getenv("NRFF_REFERENCE");
    const std::filesystem::path path =
        given != nullptr ? given
                         : std::filesystem::path(NRFF_SOURCE_DIR) / "../shared/reference/nrff_reference.safetensors";
    if (!std::filesystem::exists(path)) GTEST_SKIP() << "no reference at " << path << "; set NRFF_REFERENCE";
    file_ = std::make_unique<SafetensorsFile>(path);
  }
  template <typename T>
  std::vector<T> Values(const std::string& name) const {
    const auto& tensor = file_->Get(name);
    EXPECT_EQ(tensor.dtype, DTypeOf<T>()) << name;
    std::vector<T> values(tensor.n_elements);
    std::memcpy(values.data(), tensor.data, tensor.n_bytes());
    return values;
  }
  std::unique_ptr<SafetensorsFile> file_;
};

TEST_F(ReferenceTest, SamplesAreTheReferencesInsideSamples) {
  constexpr double kTolerance = 5e-7;  // the authors' multiples of the step are rounded to float
  const auto rays = Values<double>("render/rays"), aabb = Values<double>("render/aabb"), t = Values<double>("render/t");
  const auto inside = Values<uint8_t>("render/inside");
  const auto n_rays = static_cast<int64_t>(rays.size()) / 6, n_steps = static_cast<int64_t>(t.size()) / n_rays;
  std::vector<double> origins, directions;
  for (int64_t r = 0; r < n_rays; ++r) {
    origins.insert(origins.end(), &rays[6 * r], &rays[6 * r + 3]);
    directions.insert(directions.end(), &rays[6 * r + 3], &rays[6 * r] + 6);
  }
  MarchArgs<double> args;
  args.n_rays = n_rays;
  args.origins = origins.data();
  args.directions = directions.data();
  const OccupancyGrid grid(8);
  args.occupancy = grid.bits();
  args.map = SceneMap::FromBox({aabb[0], aabb[1], aabb[2]}, {aabb[3], aabb[4], aabb[5]}, false);
  args.step = Values<double>("render/step_size")[0];
  args.near = std::stod(file_->Metadata("near"));
  args.far = std::stod(file_->Metadata("far"));
  std::vector<int64_t> offsets(n_rays + 1);
  const int64_t n = CountSamplesCpu(args, offsets.data());
  std::vector<double> my_t(n), delta(n), points(3 * n);
  std::vector<int64_t> ray_index(n);
  FillSamplesCpu(args, offsets.data(),
                 SampleArrays<double>{my_t.data(), delta.data(), points.data(), ray_index.data()});
  for (int64_t r = 0; r < n_rays; ++r) {
    std::vector<double> expected;
    for (int64_t i = r * n_steps; i < (r + 1) * n_steps; ++i) {
      // The entry point lies on the box's face, in or out by rounding alone.
      bool on_face = false;
      for (int k = 0; k < 3; ++k) {
        const double x = origins[3 * r + k] + t[i] * directions[3 * r + k];
        on_face |= std::abs(x - aabb[k]) < 1e-12 || std::abs(x - aabb[3 + k]) < 1e-12;
      }
      const bool sampled = offsets[r] + static_cast<int64_t>(expected.size()) < offsets[r + 1] &&
                           std::abs(my_t[offsets[r] + expected.size()] - t[i]) < kTolerance;
      if (on_face ? sampled : inside[i] != 0) expected.push_back(t[i]);
    }
    const std::vector<double> mine(my_t.begin() + offsets[r], my_t.begin() + offsets[r + 1]);
    EXPECT_THAT(mine, testing::Pointwise(testing::DoubleNear(kTolerance), expected)) << "ray " << r;
  }
  EXPECT_THAT(delta, testing::Each(args.step));
}

TEST_F(ReferenceTest, WeightsAndBackgroundAreTheReferences) {
  const auto density = Values<double>("render/density"), expected = Values<double>("render/weight");
  const auto background = Values<double>("render/background_weight");
  const auto n_rays = static_cast<int64_t>(background.size()), n_steps = static_cast<int64_t>(density.size()) / n_rays;
  const auto t = Values<double>("render/t");
  const double scale = std::stod(file_->Metadata("distance_scale"));
  std::vector<int64_t> offsets(n_rays + 1);
  for (int64_t r = 0; r <= n_rays; ++r) offsets[r] = r * n_steps;
  std::vector<double> deltas(density.size());
  for (size_t i = 0; i < deltas.size(); ++i) {  // the authors' last interval has no length
    deltas[i] = (i + 1) % n_steps == 0 ? 0 : scale * (t[i + 1] - t[i]);
  }
  std::vector<double> weights(density.size()), transmittance(n_rays);
  std::vector<int64_t> n_reached(n_rays);
  WeightsForwardCpu(WeightsArgs<double>{n_rays, offsets.data(), density.data(), deltas.data(), 0, weights.data(),
                                        transmittance.data(), n_reached.data()});
  const double tolerance = 1e-10 * static_cast<double>(n_steps);  // the authors' factors are 1 − α + 1e-10
  for (int64_t r = 0; r < n_rays; ++r) {
    for (int64_t i = r * n_steps; i < (r + 1) * n_steps; ++i) EXPECT_NEAR(weights[i], expected[i], tolerance);
    EXPECT_NEAR(transmittance[r], background[r], tolerance);
  }
}

// ----------------------------------------------------------------------------------------------------- view writer

Scene TwoViews() {
  Scene scene;
  for (int i = 0; i < 2; ++i) {
    View view{.id = i == 0 ? "000000" : "000001",
              .name = "photo " + std::to_string(i),
              .width = 24,
              .height = 16,
              .fx = 20,
              .fy = 20,
              .cx = 12,
              .cy = 8};
    view.split = Split::kTest;
    view.scene_from_camera = {1, 0, 0, 0.1 * i, 0, 1, 0, 0, 0, 0, 1, -2, 0, 0, 0, 1};
    scene.views.push_back(view);
  }
  return scene;
}

TEST(RenderViewsTest, AViewThatWasFinishedIsKeptAndTheBytesAreTheSame) {
  const TemporaryDirectory directory;
  const GaussianBall ball(torch::kFloat);
  const OccupancyGrid grid(16);
  const RenderSource source{ball, grid, SceneMap{}, Exact(0.02)};
  const std::vector<View> views = TwoViews().views;
  const RenderFacts whole = RenderViews(source, views, "", directory.path());
  EXPECT_EQ(whole.n_views, 2);
  EXPECT_EQ(whole.n_kept, 0);
  EXPECT_GT(whole.samples_per_ray, 10);
  std::map<std::string, std::string> before;
  for (const char* layer : kRenderLayers) {
    for (const View& view : views) {
      const std::string path = std::string(layer) + "/" + view.id + ".png";
      before[path] = ReadFile(directory.path() / path);
    }
  }
  const Json renders = ReadJson(directory.path() / kRendersFile);
  EXPECT_EQ(renders["views"][1]["depth"], "depth/000001.png");
  EXPECT_EQ(renders["views"][1]["split"], "test");
  EXPECT_EQ(renders["depth_unit"], 10. / 65535);

  // As a kill after the first view leaves it.
  std::filesystem::remove(directory.path() / "done/000001.json");
  std::filesystem::remove(directory.path() / "depth/000001.png");
  std::filesystem::remove(directory.path() / kRendersFile);
  const RenderFacts rest = RenderViews(source, views, "", directory.path());
  EXPECT_EQ(rest.n_kept, 1);
  EXPECT_DOUBLE_EQ(rest.samples_per_ray, whole.samples_per_ray);
  for (const auto& [path, bytes] : before) EXPECT_EQ(ReadFile(directory.path() / path), bytes) << path;
  EXPECT_EQ(ReadJson(directory.path() / kRendersFile), renders);
}

TEST(RenderViewsTest, ValuesThatAreNotNumbersAreReportedWithTheView) {
  const TemporaryDirectory directory;
  const GaussianBall broken(torch::kFloat, std::nan(""));
  const OccupancyGrid grid(8);
  try {
    RenderViews({broken, grid, SceneMap{}, Exact(0.1)}, TwoViews().views, "", directory.path());
    FAIL();
  } catch (const Error& error) {
    EXPECT_EQ(error.code(), ExitCode::kCorrupt);
    EXPECT_THAT(error.what(), testing::HasSubstr("photo 0"));
  }
}

}  // namespace
}  // namespace nrff
