// Times full training steps and whole views of one state of the paper's model; our half of
// tests/bench/against_authors.py.
//
//   step_bench prepare MODEL_DIR SCENE_DIR OUT.safetensors
//       batches of rays with their colours, the rays of one test view, and for the first batch, without jitter and
//       with nothing left out but samples of little weight: the loss and the gradient of every parameter
//   step_bench run MODEL_DIR SCENE_DIR N_STEPS N_VIEWS
//       JSON on stdout: seconds of every step and of every rendering, samples, losses
//   step_bench views MODEL_DIR SCENE_DIR
//       JSON on stdout: for several tolerances of colour the seconds of a view, points shaded, and how far it is from
//       the one with every sample shaded
//
// Steps are [Han23]'s: kRays rays, step of the last stage (½ · side / 300), weight threshold 1e-4, orientation and
// density L1 losses, Adam, all cells of the occupancy grid set anew before the first step as the schedule does.

#include <omp.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <string>
#include <vector>

#include "model/checkpoint.h"
#include "model/kernels/adam.h"
#include "model/safetensors.h"
#include "model/schedule.h"
#include "model/training_step.h"
#include "pipeline/json.h"
#include "render/compute.h"
#include "render/image_renderer.h"

namespace nrff {
namespace {

using Clock = std::chrono::steady_clock;

constexpr int kRays = 4096, kBatches = 8;
constexpr uint64_t kSeed = 0;

double SecondsSince(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

std::vector<View> ViewsOf(const Scene& scene, Split split) {
  std::vector<View> views;
  for (const int i : scene.ViewsOf(split)) views.push_back(scene.views[i]);
  return views;
}

class Bench {
 public:
  Bench(const std::filesystem::path& model_dir, const std::filesystem::path& scene_dir)
      : model_(LoadModel(model_dir)),
        scene_(LoadScene(scene_dir)),
        pack_(scene_dir),
        pixels_(ViewsOf(scene_, Split::kTrain), pack_, model_->options.background),
        view_(ViewsOf(scene_, Split::kTest).at(0)) {
    options_ = model_->options;
    options_.step = MarchingStep(config_, int(config_.step_voxels.size()) - 1, model_->map);
    options_.weight_threshold = options_.stop_transmittance = config_.weight_threshold_last;
    weights_ = {.orientation = config_.orientation_weight, .density_l1 = config_.density_l1_weight_later};
  }

  void Prepare(const std::filesystem::path& out) {
    std::vector<TensorToWrite> tensors;
    std::vector<PixelSource::Batch> batches;
    batches.reserve(kBatches);
    for (int i = 0; i < kBatches; ++i) batches.push_back(pixels_.Draw(kRays, kSeed, uint64_t(i)));
    const auto add = [&](const std::string& name, const torch::Tensor& tensor) {
      tensors.push_back({name, DType::kF32, tensor.sizes().vec(), tensor.const_data_ptr<float>()});
    };
    for (int i = 0; i < kBatches; ++i) {
      const std::string prefix = "batch/" + std::to_string(i) + "/";
      add(prefix + "origins", batches[i].rays.origins);
      add(prefix + "directions", batches[i].rays.directions);
      add(prefix + "target", batches[i].target);
    }
    const torch::Tensor pixels = torch::empty({int64_t(view_.width) * view_.height, 3}, torch::kInt32);
    auto* pixel = pixels.mutable_data_ptr<int32_t>();
    for (int y = 0; y < view_.height; ++y) {
      for (int x = 0; x < view_.width; ++x, pixel += 3) {
        pixel[0] = 0;
        pixel[1] = x;
        pixel[2] = y;
      }
    }
    const Rays rays = RaysThroughPixels({view_}, pixels, torch::kFloat);
    add("view/origins", rays.origins);
    add("view/directions", rays.directions);
    SetOccupancy();
    const RenderedImage image = Render();
    tensors.push_back({"view/rgb", DType::kF32, {view_.height, view_.width, 3}, image.rgb.data()});

    RenderOptions exact = options_;
    exact.stop_transmittance = 0;
    const OccupancyGrid everywhere(config_.occupancy_resolution);
    TrainingStep step(*model_->field);
    const TrainingStep::Result result = step.Run(batches[0], nullptr, everywhere, model_->map, exact, weights_);
    const auto& parameters = model_->field->parameters();
    for (size_t i = 0; i < parameters.size(); ++i) add("gradient/" + parameters[i].name, step.gradients()[i]);
    const Json facts = {{"aabb_min", Corner(-1)},
                        {"aabb_max", Corner(1)},
                        {"step", options_.step},
                        {"near", options_.near},
                        {"far", options_.far},
                        {"background", options_.background},
                        {"weight_threshold", options_.weight_threshold},
                        {"orientation_weight", weights_.orientation},
                        {"density_l1_weight", weights_.density_l1},
                        {"grid_rate", config_.grid_rate},
                        {"network_rate", config_.network_rate},
                        {"occupancy_resolution", config_.occupancy_resolution},
                        {"occupancy_threshold", config_.occupancy_threshold / model_->field->config().density_scale},
                        {"field", ToJson(model_->field->config())},
                        {"mse", result.mse},
                        {"orientation", result.orientation},
                        {"n_shaded", result.n_shaded}};
    WriteSafetensors(out, std::move(tensors), {{"facts", facts.dump()}});
  }

  Json Run(int n_steps, int n_views) {
    SetOccupancy();
    Json result = {{"threads", omp_get_max_threads()}, {"occupied_fraction", model_->occupancy.OccupiedFraction()}};
    // The views first: steps change the model.
    for (int i = 0; i < n_views; ++i) {
      const auto start = Clock::now();
      const RenderedImage image = Render();
      result["view_seconds"].push_back(SecondsSince(start));
      result["view_samples"] = image.n_samples;
      result["view_shaded"] = image.n_shaded;
    }
    TrainingStep step(*model_->field);
    const auto& parameters = model_->field->parameters();
    std::vector<torch::Tensor> m, v;
    for (const auto& parameter : parameters) {
      m.push_back(torch::zeros(parameter.value.sizes()));
      v.push_back(torch::zeros(parameter.value.sizes()));
    }
    for (int t = 0; t < n_steps; ++t) {
      const auto start = Clock::now();
      const PixelSource::Batch batch = pixels_.Draw(kRays, kSeed, uint64_t(t % kBatches));
      RenderOptions options = options_;
      options.jitter = {kSeed, uint64_t(t)};
      const TrainingStep::Result done = step.Run(batch, nullptr, model_->occupancy, model_->map, options, weights_);
      for (size_t i = 0; i < parameters.size(); ++i) {
        AdamStep<float>({.learning_rate = parameters[i].is_grid ? config_.grid_rate : config_.network_rate,
                         .beta1 = config_.beta1,
                         .beta2 = config_.beta2,
                         .epsilon = config_.epsilon},
                        t + 1, m[i].numel(), step.gradients()[i].const_data_ptr<float>(),
                        parameters[i].value.mutable_data_ptr<float>(), m[i].mutable_data_ptr<float>(),
                        v[i].mutable_data_ptr<float>());
      }
      result["step_seconds"].push_back(SecondsSince(start));
      result["step_samples"].push_back(done.n_samples);
      result["step_shaded"].push_back(done.n_shaded);
      result["step_mse"].push_back(done.mse);
    }
    return result;
  }

  Json Views() {
    SetOccupancy();
    const RenderedImage exact = Render(0);
    Json result = Json::array();
    // 1e-6: all samples, with bf16 products.
    for (const double steps : {0., 1e-6, 0.125, 0.25, 0.5, 1., 2., 4.}) {  // of 8 bits
      const auto start = Clock::now();
      const RenderedImage image = Render(steps / 255);
      const double seconds = SecondsSince(start);
      double sum = 0, most = 0;
      for (size_t i = 0; i < image.rgb.size(); ++i) {
        const double difference = std::abs(double(image.rgb[i]) - exact.rgb[i]);
        sum += difference * difference;
        most = std::max(most, difference);
      }
      result.push_back({{"tolerance", steps / 255},
                        {"seconds", seconds},
                        {"densities", image.n_samples},
                        {"shaded", image.n_shaded},
                        {"psnr_to_exact", -10 * std::log10(std::max(sum / double(image.rgb.size()), 1e-20))},
                        {"most_difference", most}});
    }
    return result;
  }

 private:
  Json Corner(double u) const {
    const double corner[3] = {u, u, u};
    double scene[3];
    model_->map.ToScene(corner, scene);
    return scene;
  }

  void SetOccupancy() {
    model_->occupancy = OccupancyGrid(config_.occupancy_resolution);
    OccupancyGrid::UpdateOptions options;
    options.step = options_.step;
    options.decay = float(config_.occupancy_decay);
    options.threshold = float(config_.occupancy_threshold);
    options.dilate = config_.occupancy_dilate;
    model_->occupancy.Update(*model_->field, options);
  }

  // As nrff-render does.
  RenderedImage Render(double colour_tolerance = kEightBitTolerance) const {
    RenderOptions options = PictureOptions(options_, colour_tolerance > 0 ? 8 : 16);
    options.colour_tolerance = colour_tolerance;
    return RenderImage(*model_->field, model_->occupancy, model_->map, view_, options);
  }

  const TrainConfig config_;  // the paper's
  std::unique_ptr<LoadedModel> model_;
  const Scene scene_;
  const ImagePack pack_;
  const PixelSource pixels_;
  const View view_;
  RenderOptions options_;
  LossWeights weights_;
};

int Main(int argc, char** argv) {
  const std::string mode = argc > 1 ? argv[1] : "";
  if (!(mode == "prepare" && argc == 5) && !(mode == "run" && argc == 6) && !(mode == "views" && argc == 4)) {
    std::fprintf(stderr,
                 "usage: step_bench prepare MODEL_DIR SCENE_DIR OUT.safetensors\n"
                 "       step_bench run MODEL_DIR SCENE_DIR N_STEPS N_VIEWS\n"
                 "       step_bench views MODEL_DIR SCENE_DIR\n");
    return 2;
  }
  SetThreads(0);
  Bench bench(argv[2], argv[3]);
  if (mode == "prepare") {
    bench.Prepare(argv[4]);
  } else if (mode == "views") {
    std::printf("%s\n", bench.Views().dump(1).c_str());
  } else {
    std::printf("%s\n", bench.Run(std::stoi(argv[4]), std::stoi(argv[5])).dump().c_str());
  }
  return 0;
}

}  // namespace
}  // namespace nrff

int main(int argc, char** argv) {
  try {
    return nrff::Main(argc, argv);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "step_bench: %s\n", error.what());
    return 1;
  }
}
