// The training step's hand-written backward pass against autograd in double: the same samples, the same losses, all
// gradients.

#include "model/training_step.h"

#include <ATen/ATen.h>
#include <c10/core/GradMode.h>
#include <gtest/gtest.h>
#include <omp.h>

#include <memory>
#include <optional>

#include "model/losses.h"
#include "render/compute.h"
#include "tests/step_case.h"

namespace nrff {
namespace {

using torch::Tensor;

// The field without its finest levels is the field with nothing on them.
TEST(NrffField, WithoutItsFinestLevelsIsAsIfTheyWereZero) {
  const FieldConfig config = SmallField({"", false, Activation::kGelu, {}});
  const NrffField field(config, torch::kFloat, 3);
  const std::unique_ptr<RadianceField> coarser = field.WithoutFinestLevels(2);
  {
    const c10::NoGradGuard no_grad;
    for (size_t grid = 0; grid < 2; ++grid) {
      const GridLayout& layout = grid == 0 ? field.density_layout() : field.appearance_layout();
      const int64_t kept = layout.levels[1].plane_offsets[0];
      Tensor values = field.parameters()[grid].value;
      values.narrow(0, kept, layout.n_parameters - kept).zero_();
    }
  }
  at::manual_seed(4);
  const Tensor points = 2 * at::rand({50, 3}, torch::kFloat) - 1, directions = at::randn({50, 3}, torch::kFloat);
  const Tensor unit = directions / directions.norm(2, {1}, true);
  EXPECT_LT((coarser->Density(points) - field.Density(points)).abs().max().item<double>(), 1e-5);
  EXPECT_LT((coarser->Shade(points, unit).rgb - field.Shade(points, unit).rgb).abs().max().item<double>(), 1e-6);
  EXPECT_EQ(field.WithoutFinestLevels(3), nullptr);
  EXPECT_EQ(coarser->WithoutFinestLevels(1), nullptr);
}

Rays Aimed(int64_t n, int seed) {
  at::manual_seed(seed);
  const Tensor origins = at::randn({n, 3}, torch::kFloat);
  const Tensor from = 2.5 * origins / origins.norm(2, {1}, true);
  const Tensor towards = 0.8 * (2 * at::rand({n, 3}, torch::kFloat) - 1) - from;
  return {from.contiguous(), (towards / towards.norm(2, {1}, true)).contiguous()};
}

Samples InDouble(Samples samples) {
  for (Tensor* tensor : {&samples.t, &samples.delta, &samples.points}) *tensor = tensor->to(torch::kDouble);
  return samples;
}

class TrainingStepTest : public ::testing::TestWithParam<StepCase> {};

TEST_P(TrainingStepTest, HasAutogradsGradientsInDouble) {
  const StepCase& c = GetParam();
  const FieldConfig config = SmallField(c);
  const NrffField field(config, torch::kFloat, 3), exact(config, torch::kDouble, 3);
  for (const NrffField* f : {&field, &exact}) SetCorrections(*f);
  const SceneMap map = SceneMap::FromBox({-1, -1.1, -0.9}, {1, 0.9, 1}, c.unbounded);
  const OccupancyGrid occupancy(32);
  RenderOptions options;
  options.step = 0.05;
  options.near = 0.1;
  options.far = 6;
  options.stop_transmittance = c.stop;
  options.weight_threshold = c.threshold;
  options.background = 0.4;
  options.jitter = {7, 5};
  const PixelSource::Batch batch{Aimed(300, 1), at::rand({300, 3}, torch::kFloat),
                                 at::randint(kCorrectedViews, {300}, torch::kInt)};
  std::optional<DepthSource::Batch> depths;
  if (c.n_depths > 0) {
    depths = DepthSource::Batch{Aimed(c.n_depths, 2), 2 + at::rand({c.n_depths}, torch::kFloat),
                                0.2 + at::rand({c.n_depths}, torch::kFloat)};
  }

  TrainingStep step(field);
  step.Run(batch, nullptr, occupancy, map, options, {});  // leftovers of another step must not matter
  const TrainingStep::Result result = step.Run(batch, depths ? &*depths : nullptr, occupancy, map, options, c.weights);

  const auto in_double = [](const Rays& rays) {
    return Rays{rays.origins.to(torch::kDouble), rays.directions.to(torch::kDouble)};
  };
  const RenderResult rendered =
      RenderSamples(exact, InDouble(MarchRays(occupancy, map, batch.rays, options)), in_double(batch.rays), options);
  // The sparsity loss sees what lies before the stop.
  const Tensor seen = rendered.weights > 0;
  Tensor rgb = rendered.rgb;
  if (config.corrected_views > 0) {
    const Tensor opacity = rendered.opacity.unsqueeze(1), light = rgb - (1 - opacity) * options.background;
    const Tensor correction = exact.colour_corrections().index_select(0, batch.view).view({-1, 3, 4});
    rgb = rgb + correction.matmul(at::cat({light, opacity}, 1).unsqueeze(2)).squeeze(2);
  }
  const Tensor mse = MseLoss(rgb, batch.target.to(torch::kDouble));
  const Tensor orientation =
      OrientationLoss(rendered.shaded_weights, rendered.shaded_normals, rendered.shaded_directions);
  const Tensor sparsity = SparsityLoss(rendered.sigma.index({seen}), rendered.delta.index({seen}), 300);
  Tensor loss = mse + c.weights.orientation * orientation + c.weights.density_l1 * exact.DensityL1() +
                c.weights.sparsity * sparsity;
  if (config.corrected_views > 0) loss = loss + c.weights.correction * CorrectionLoss(exact.colour_corrections());
  if (depths) {
    RenderOptions depth_options = options;
    depth_options.jitter_purpose = RandomStream::kDepthJitter;
    const Samples samples = InDouble(MarchRays(occupancy, map, depths->rays, depth_options));
    const Visibility visibility = MeasureVisibility(exact, samples, options.stop_transmittance);
    const Tensor depth = DepthLoss(visibility.weights, samples.t, samples.ray_index,
                                   depths->distance.to(torch::kDouble), depths->spread.to(torch::kDouble));
    EXPECT_NEAR(result.depth, depth.item<double>(), 1e-5);
    loss = loss + c.weights.depth * depth;
  }
  loss.backward();

  EXPECT_EQ(result.n_shaded, rendered.n_shaded);
  EXPECT_GT(result.n_shaded, 1000);
  EXPECT_NEAR(result.mse, mse.item<double>(), 1e-6);
  EXPECT_NEAR(result.orientation, orientation.item<double>(), 1e-6);
  for (size_t i = 0; i < field.parameters().size(); ++i) {
    const Tensor expected = exact.parameters()[i].value.grad();
    const Tensor difference = step.gradients()[i].to(torch::kDouble) - expected;
    const double largest = expected.abs().max().item<double>();
    EXPECT_LT(difference.abs().max().item<double>(), 3e-5 * largest) << field.parameters()[i].name << " " << largest;
  }
}

const auto kCaseName = [](const auto& info) { return info.param.name; };

INSTANTIATE_TEST_SUITE_P(Model, TrainingStepTest, ::testing::ValuesIn(CommonStepCases()), kCaseName);

INSTANTIATE_TEST_SUITE_P(
    OnTheCpuAlone, TrainingStepTest,
    ::testing::Values(StepCase{"NothingStops", false, Activation::kGelu, {.orientation = 0.3}, 0, 1e-6},
                      With("IntegratedDirectionalEncoding",
                           [](FieldConfig& f) { f.directional_encoding = DirectionalEncoding::kIde; }),
                      With("PositionalEncoding",
                           [](FieldConfig& f) { f.directional_encoding = DirectionalEncoding::kPe; })),
    kCaseName);

}  // namespace
}  // namespace nrff
