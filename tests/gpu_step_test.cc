// The step of a GPU against the step of the CPU, which is held against autograd in double: the same batch, the same
// losses, all gradients. Where there is no GPU its kernels run in the emulation of tests/emulation.

#include <ATen/ATen.h>
#include <gtest/gtest.h>

#include <cmath>
#include <fstream>

#include "model/cuda/gpu_model.h"
#include "model/depth_batch.h"
#include "model/training_step.h"
#include "render/kernels/random.h"
#include "tests/gpu_under_test.h"
#include "tests/step_case.h"
#include "tests/temporary_directory.h"

namespace nrff {
namespace {

using device::StepControl;
using device::StepResult;
using torch::Tensor;

constexpr int kOccupancyResolution = 32;
constexpr uint64_t kSeed = 7;
constexpr size_t kPlenty = size_t{1} << 34;

// Six cameras around the origin, looking at it, whose pixels are noise; every other one has alpha, and of one of these
// about half of the pixels count.
Scene WriteNoiseScene(const std::filesystem::path& dir) {
  Scene scene;
  scene.near = 0.1;
  scene.far = 6;
  std::ofstream pack(dir / kPackFile, std::ios::binary);
  uint64_t offset = 0;
  for (int i = 0; i < 6; ++i) {
    const double a = i, z[3] = {-std::cos(a), -std::sin(a), 0}, x[3] = {-std::sin(a), std::cos(a), 0};
    View view;
    view.width = 20 + i;
    view.height = 16;
    view.channels = i % 2 == 0 ? 3 : 4;
    view.masked = i == 3;
    view.pack_offset = offset;
    view.fx = view.fy = 18;
    view.cx = 9.5 + i;
    view.cy = 8;
    view.scene_from_camera = {x[0], 0, z[0], -2.5 * z[0], x[1], 0, z[1], -2.5 * z[1], 0, -1, 0, 0.1 * i, 0, 0, 0, 1};
    scene.views.push_back(view);
    const int64_t n = int64_t(view.width) * view.height * view.channels;
    for (int64_t k = 0; k < n; ++k) {
      const uint64_t bits = RandomBits(1, 2, offset + k);
      pack.put(char(view.masked && k % 4 == 3 && bits % 2 == 0 ? 255 : bits & 0xff));
    }
    offset += n;
  }
  return scene;
}

std::vector<SparseDepth> NoiseDepths(const Scene& scene) {
  std::vector<SparseDepth> depths;
  for (uint32_t i = 0; i < 50; ++i) {
    depths.push_back({uint32_t(i % scene.views.size()), {}, 0.2F});
    for (float& x : depths.back().position) x = Uniform(3, i, uint64_t(&x - depths.back().position)) - 0.5F;
  }
  return depths;
}

// A scene and a model on both sides.
struct Sides {
  explicit Sides(const StepCase& c)
      : scene(WriteNoiseScene(dir.path())),
        pack(dir.path()),
        depths(scene, c.n_depths > 0 ? NoiseDepths(scene) : std::vector<SparseDepth>{}),
        pixels(scene.views, pack, kBackground),
        field(SmallField(c), torch::kFloat, 3),
        model(MakeGpuModel(field)),
        map(SceneMap::FromBox({-1, -1.1, -0.9}, {1, 0.9, 1}, c.unbounded)),
        occupancy(kOccupancyResolution) {
    SetCorrections(field);
    gpu_scene = MakeGpuScene(pixels, depths);
    options.step = 0.05;
    options.near = scene.near;
    options.far = scene.far;
    options.stop_transmittance = c.stop;
    options.weight_threshold = c.threshold;
    options.background = kBackground;
    options.jitter = {kSeed, kStep};
    control.seed = kSeed;
    control.step = kStep;
    control.n_rays = 300;
    control.n_depths = c.n_depths;
    control.march_step = options.step;
    control.near = scene.near;
    control.far = scene.far;
    control.map = map;
    control.stop_transmittance = float(c.stop);
    control.weight_threshold = float(c.threshold);
    control.background = kBackground;
    control.orientation = float(c.weights.orientation);
    control.density_l1 = float(c.weights.density_l1);
    control.sparsity = float(c.weights.sparsity);
    control.depth = float(c.weights.depth);
    control.correction = float(c.weights.correction);
    control.correction_rate = 3e-3;
    control.grid_rate = 0.02;
    control.network_rate = 1e-3;
  }

  std::unique_ptr<GpuTrainer> MakeTrainer(const GpuTrainerOptions& with) const {
    std::unique_ptr<GpuTrainer> trainer = GpuUnderTest()(model, gpu_scene, kOccupancyResolution, with);
    const std::vector<float> zeros(model.n_parameters);
    trainer->SetParameters(Flatten(model, ValuesOf(field)).data());
    trainer->SetMoments(zeros.data(), zeros.data(), 0);
    trainer->SetOccupancy(occupancy.bits());
    return trainer;
  }

  static constexpr float kBackground = 0.4F;
  static constexpr uint64_t kStep = 5;
  TemporaryDirectory dir;
  Scene scene;
  ImagePack pack;
  DepthSource depths;
  PixelSource pixels;
  NrffField field;
  GpuModel model;
  GpuScene gpu_scene;
  SceneMap map;
  OccupancyGrid occupancy;
  RenderOptions options;
  StepControl control;
};

constexpr GpuRoom kRoom{512, 32768, 32768};

class GpuStepTest : public ::testing::TestWithParam<StepCase> {
 protected:
  void SetUp() override {
    if (!GpuIsThere()) GTEST_SKIP() << "there is no GPU";
    LimitGpuMemory(kPlenty);
  }
};

// What the CPU's step leaves.
struct Expected {
  TrainingStep::Result result;
  std::vector<Tensor> gradients;
};
Expected OnCpu(const Sides& sides, const StepCase& c) {
  TrainingStep step(sides.field);
  const PixelSource::Batch batch = sides.pixels.Draw(sides.control.n_rays, kSeed, Sides::kStep);
  std::optional<DepthSource::Batch> depths;
  if (c.n_depths > 0) depths = sides.depths.Draw(c.n_depths, kSeed, Sides::kStep, sides.map, sides.options.step);
  Expected expected;
  expected.result = step.Run(batch, depths ? &*depths : nullptr, sides.occupancy, sides.map, sides.options, c.weights);
  for (const Tensor& gradient : step.gradients()) expected.gradients.push_back(gradient.clone());
  return expected;
}

std::vector<Tensor> LikeParameters(const Sides& sides, const std::vector<float>& flat) {
  std::vector<Tensor> tensors;
  for (const NrffField::Parameter& parameter : sides.field.parameters()) {
    tensors.push_back(at::empty(parameter.value.sizes(), torch::kFloat));
  }
  Unflatten(sides.model, flat, tensors);
  return tensors;
}

TEST_P(GpuStepTest, FindsWhatTheCpuFindsAndItsGradients) {
  const StepCase& c = GetParam();
  Sides sides(c);
  const Expected expected = OnCpu(sides, c);
  const auto trainer = sides.MakeTrainer({.precision = GpuPrecision::kFloat, .room = kRoom});
  trainer->Step(sides.control);
  const StepResult found = trainer->Finish().front();
  EXPECT_EQ(found.applied, 1);
  EXPECT_EQ(found.adam_t, 1);
  EXPECT_EQ(found.n_shaded, expected.result.n_shaded);
  EXPECT_GT(found.n_shaded, 1000);
  EXPECT_NEAR(found.mse, expected.result.mse, 1e-6 * expected.result.mse);
  EXPECT_NEAR(found.orientation, expected.result.orientation, 1e-5 * expected.result.orientation);
  EXPECT_NEAR(found.sparsity, expected.result.sparsity, 1e-5 * expected.result.sparsity);
  EXPECT_NEAR(found.depth, expected.result.depth, 1e-5);

  // The first moments are a tenth of the gradients, L1 term included.
  std::vector<float> p(sides.model.n_parameters), m(p.size()), v(p.size());
  trainer->GetState(p.data(), m.data(), v.data());
  const std::vector<Tensor> moments = LikeParameters(sides, m), values = LikeParameters(sides, p);
  for (size_t i = 0; i < moments.size(); ++i) {
    const Tensor difference = moments[i] / (1 - sides.control.beta1) - expected.gradients[i];
    const double largest = expected.gradients[i].abs().max().item<double>();
    EXPECT_LT(difference.abs().max().item<double>(), 3e-5 * largest)
        << sides.field.parameters()[i].name << " " << largest;
    // Adam by the letter of its own moments.
    const Tensor second = LikeParameters(sides, v)[i];
    const NrffField::Parameter& parameter = sides.field.parameters()[i];
    const double rate = parameter.is_grid                                           ? sides.control.grid_rate
                        : parameter.value.is_same(sides.field.colour_corrections()) ? sides.control.correction_rate
                                                                                    : sides.control.network_rate;
    const Tensor update =
        rate * (moments[i] / (1 - sides.control.beta1)) / ((second / (1 - sides.control.beta2)).sqrt() + 1e-8);
    const Tensor off = values[i] - (sides.field.parameters()[i].value.detach() - update);
    EXPECT_LT(off.abs().max().item<double>(), 1e-6) << sides.field.parameters()[i].name;
  }
}

INSTANTIATE_TEST_SUITE_P(Model, GpuStepTest, ::testing::ValuesIn(CommonStepCases()),
                         [](const auto& info) { return info.param.name; });

}  // namespace
}  // namespace nrff
