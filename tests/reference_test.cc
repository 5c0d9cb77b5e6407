// The model against values of the authors' code (reference in double): encodings, shading, weights, colours, losses,
// all gradients, ten Adam steps.
//
// Files have one form: param/… under the authors' names; encoding/… (features at points, gradients of Σ upstream ·
// feature with respect to the grids); shading/… (all parts, from view_direction and appearance_feature); render/…
// (rays, sample positions, weights, colours); loss/…; grad/… of the total loss MSE + 0.3 · orientation + 8e-5 · L1;
// adam/loss before each of ten steps. Parameters and gradients are F32, the rest F64; settings are in the metadata.
//
//   authors   NRFF_REFERENCE, or ../shared/reference/nrff_reference.safetensors beside the source tree
//   own       tests/data/nrff_reference_small.safetensors, written by tests/make_reference.cc from the oracle

#include <ATen/ATen.h>
#include <gtest/gtest.h>

#include <cstdlib>
#include <filesystem>
#include <memory>
#include <ostream>

#include "tests/reference_file.h"
#include "tests/reference_models.h"

namespace nrff::testing {
namespace {

using torch::Tensor;

std::filesystem::path AuthorsFile() {
  if (const char* path = std::getenv("NRFF_REFERENCE")) return path;
  return std::filesystem::path(NRFF_SOURCE_DIR) / "../shared/reference/nrff_reference.safetensors";
}

struct Case {
  std::string name;
  bool authors;
  ModelKind kind;
  // Largest differences, relative to the largest value of a tensor. `exact` where the formulae agree, `rendered` where
  // the authors' 1e-10 in the transmittance shows, `gradient` for what the file has rounded to float.
  double exact, rendered, gradient;
};

void PrintTo(const Case& c, std::ostream* out) { *out << c.name; }

const Case kCases[] = {
    {"AuthorsOracle", true, ModelKind::kOracle, 1e-9, 1e-9, 1e-7},
    {"AuthorsField", true, ModelKind::kFieldDouble, 1e-9, 1e-7, 1e-7},
    {"AuthorsFieldFloat", true, ModelKind::kFieldFloat, 1e-4, 1e-4, 1e-4},
    {"OwnField", false, ModelKind::kFieldDouble, 1e-9, 1e-7, 1e-7},
    {"OwnFieldFloat", false, ModelKind::kFieldFloat, 1e-4, 1e-4, 1e-4},
};

class ReferenceTest : public ::testing::TestWithParam<Case> {
 protected:
  void SetUp() override {
    const std::filesystem::path path =
        GetParam().authors ? AuthorsFile()
                           : std::filesystem::path(NRFF_SOURCE_DIR) / "tests/data/nrff_reference_small.safetensors";
    if (GetParam().authors && !std::filesystem::exists(path)) {
      GTEST_SKIP() << "no reference values of the authors' code at " << path << "; set NRFF_REFERENCE";
    }
    file_ = std::make_unique<SafetensorsFile>(path);
    model_ = MakeReferenceModel(GetParam().kind, *file_);
  }

  Tensor Read(const std::string& name) const { return ReadTensor(*file_, name); }

  void ExpectClose(const std::string& name, const Tensor& value, double tolerance) const {
    ExpectClose(name, value, Read(name), tolerance);
  }
  static void ExpectClose(const std::string& name, const Tensor& value, const Tensor& expected, double tolerance) {
    ASSERT_EQ(value.numel(), expected.numel()) << name;
    const Tensor difference = (value.detach().to(torch::kDouble).reshape(expected.sizes()) - expected).abs();
    const double scale = expected.abs().max().item<double>();
    const double error = difference.max().item<double>();
    EXPECT_TRUE(error <= tolerance * scale) << name << ": differs by " << error << " of " << scale;
  }

  Case tolerance() const { return GetParam(); }

  std::unique_ptr<SafetensorsFile> file_;
  std::unique_ptr<ReferenceModel> model_;
};

TEST_P(ReferenceTest, EncodingsAtPointsEdgesAndCorners) {
  const Tensor points = Read("encoding/points");
  const Tensor feature = model_->DensityFeature(points);
  ExpectClose("encoding/density_feature", feature, tolerance().exact);
  ExpectClose("encoding/density", model_->DensityOverScale(feature), tolerance().exact);
  ExpectClose("encoding/appearance_feature", model_->AppearanceFeature(points), tolerance().exact);
}

TEST_P(ReferenceTest, EncodingGradients) {
  const Tensor points = Read("encoding/points");
  const Tensor density = model_->DensityFeature(points), appearance = model_->AppearanceFeature(points);
  const Tensor sum = (density * Read("encoding/upstream_density_feature").to(density.scalar_type())).sum() +
                     (appearance * Read("encoding/upstream_appearance_feature").to(density.scalar_type())).sum();
  sum.backward();
  const std::map<std::string, Tensor> gradients = model_->Gradients();
  for (const auto& [name, expected] : ReadTensors(*file_, "encoding/grad/")) {
    ExpectClose("encoding/grad/" + name, gradients.at(name), expected, tolerance().gradient);
  }
}

TEST_P(ReferenceTest, EveryPartOfShading) {
  const auto parts = model_->Shade(Read("encoding/appearance_feature"), Read("shading/view_direction"));
  ASSERT_GE(parts.size(), 10U);
  for (const auto& [name, value] : parts) ExpectClose("shading/" + name, value, tolerance().exact);
}

TEST_P(ReferenceTest, WeightsColoursAndLosses) {
  const RenderedReference rendered = model_->Render(ReadRenderInput(*file_));
  ExpectClose("render/density", rendered.density, tolerance().exact);
  ExpectClose("render/weight", rendered.weight, tolerance().rendered);
  ExpectClose("render/background_weight", rendered.background_weight, tolerance().rendered);
  ExpectClose("render/rgb", rendered.rgb, tolerance().rendered);
  ExpectClose("render/depth", rendered.depth, tolerance().rendered);
  ExpectClose("loss/mse", rendered.losses.mse, tolerance().rendered);
  ExpectClose("loss/normal_orientation", rendered.losses.orientation, tolerance().rendered);
  ExpectClose("loss/density_l1", rendered.losses.density_l1, tolerance().exact);
  ExpectClose("loss/total", rendered.losses.Total(), tolerance().rendered);
}

TEST_P(ReferenceTest, GradientsOfTheTotalLoss) {
  model_->Render(ReadRenderInput(*file_)).losses.Total().backward();
  const std::map<std::string, Tensor> gradients = model_->Gradients();
  const std::map<std::string, Tensor> expected = ReadTensors(*file_, "grad/");
  EXPECT_EQ(gradients.size(), expected.size());
  for (const auto& [name, value] : expected)
    ExpectClose("grad/" + name, gradients.at(name), value, tolerance().gradient);
}

TEST_P(ReferenceTest, TenAdamSteps) {
  const RenderInput input = ReadRenderInput(*file_);
  const Tensor expected = Read("adam/loss");
  const double grid_rate = std::stod(file_->Metadata("lr_grid")), network_rate = std::stod(file_->Metadata("lr_mlp"));
  std::vector<double> losses;
  for (int step = 1; step <= expected.numel(); ++step) {
    const Tensor total = model_->Render(input).losses.Total();
    losses.push_back(total.item<double>());
    total.backward();
    model_->AdamStep(step, grid_rate, network_rate);
  }
  ExpectClose("adam/loss", at::tensor(losses, torch::kDouble), expected, tolerance().rendered);
}

INSTANTIATE_TEST_SUITE_P(Reference, ReferenceTest, ::testing::ValuesIn(kCases),
                         [](const auto& info) { return info.param.name; });

}  // namespace
}  // namespace nrff::testing
