// Steps and frames of a trained model on a GPU:
//   gpu_bench measure SCENE MODEL OUT.json     pose and train artifacts; the model stays as it is
//   gpu_bench collect OUT.json KEY=FILE…       puts JSON files into one; a file that is not there becomes null

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <fstream>
#include <optional>
#include <string>
#include <vector>

#include "model/checkpoint.h"
#include "model/cuda/gpu_library.h"
#include "model/cuda/gpu_model.h"
#include "model/cuda/gpu_renderer.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/manifest.h"
#include "render/camera_path.h"

namespace nrff {
namespace {

using Clock = std::chrono::steady_clock;

constexpr int kWarmSteps = 50, kTimedSteps = 300, kProfiledSteps = 30, kFrames = 40, kFrameSide = 800;

double SecondsSince(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

Json MeasureSteps(const GpuTrainerFactory& factory, const Scene& scene, const ImagePack& pack,
                  const LoadedModel& loaded) {
  std::vector<View> views;
  for (const int i : scene.ViewsOf(Split::kTrain)) views.push_back(scene.views[i]);
  const PixelSource pixels(views, pack, loaded.options.background);
  const DepthSource depths(scene, {});
  const GpuModel model = MakeGpuModel(*loaded.field);
  const std::vector<float> zeros(model.n_parameters);
  Json steps = Json::object();
  for (const bool use_graph : {false, true}) {
    const auto trainer = factory(model, MakeGpuScene(pixels, depths), loaded.occupancy.resolution(),
                                 {.room = {4096, 4096 * 96, 4096 * 24}, .use_graph = use_graph});
    trainer->SetParameters(Flatten(model, ValuesOf(*loaded.field)).data());
    trainer->SetMoments(zeros.data(), zeros.data(), 0);
    trainer->SetOccupancy(loaded.occupancy.bits());
    device::StepControl control = MakeControl(loaded.map, loaded.options);  // rates of zero: the model stays
    control.n_rays = 4096;
    control.jitter = true;
    control.orientation = 0.3F;
    const auto run = [&](int n) {
      double samples = 0, shaded = 0;
      const auto add = [&](const device::StepResult& result) {
        samples += double(result.n_samples);
        shaded += double(result.n_shaded);
      };
      for (int i = 0; i < n; ++i) {
        ++control.step;
        if (const auto result = trainer->Step(control)) add(*result);
      }
      for (const device::StepResult& result : trainer->Finish()) add(result);
      return std::array{samples / n, shaded / n};
    };
    run(kWarmSteps);
    const auto start = Clock::now();
    const auto [samples, shaded] = run(kTimedSteps);
    steps[use_graph ? "steps_per_second_graph" : "steps_per_second"] = kTimedSteps / SecondsSince(start);
    if (!use_graph) {
      steps["samples_per_ray"] = samples / double(control.n_rays);
      steps["shaded_per_ray"] = shaded / double(control.n_rays);
      steps["milliseconds"] = trainer->Profile(control, kProfiledSteps);
      steps["step_memory_bytes"] = trainer->bytes();
    }
  }
  return steps;
}

Json MeasureFrames(const GpuTrainerFactory& factory, const Scene& scene, const LoadedModel& loaded) {
  const GpuRenderer renderer(factory, *loaded.field, loaded.occupancy);
  const RenderOptions options = PictureOptions(loaded.options, 8);
  PathOptions frames;
  frames.n_frames = kFrames;
  frames.width = frames.height = kFrameSide;
  std::vector<double> seconds;
  double samples = 0, shaded = 0;
  const std::vector<View> views = OrbitPath(scene, frames);
  renderer.Render(views.front(), loaded.map, options);
  for (const View& view : views) {
    const auto start = Clock::now();
    const RenderedImage image = renderer.Render(view, loaded.map, options);
    seconds.push_back(SecondsSince(start));
    samples += double(image.n_samples) / (double(kFrameSide) * kFrameSide * kFrames);
    shaded += double(image.n_shaded) / (double(kFrameSide) * kFrameSide * kFrames);
  }
  std::sort(seconds.begin(), seconds.end());
  double sum = 0;
  for (const double s : seconds) sum += s;
  return {{"width", kFrameSide},           {"height", kFrameSide},
          {"mean_seconds", sum / kFrames}, {"p95_seconds", seconds[size_t(0.95 * kFrames)]},
          {"samples_per_ray", samples},    {"shaded_per_ray", shaded}};
}

void Measure(const std::string& scene_dir, const std::string& model_dir, const std::string& out) {
  const Device device = ChooseDevice("cuda");
  const Scene scene = LoadScene(scene_dir);
  const ImagePack pack(scene_dir);
  const std::unique_ptr<LoadedModel> loaded = LoadModel(model_dir);
  WriteJson(out, {{"gpu", device.decision.evidence},
                  {"nrff", Version()},
                  {"step", MeasureSteps(device.gpu, scene, pack, *loaded)},
                  {"frame", MeasureFrames(device.gpu, scene, *loaded)}});
}

void Collect(const std::string& out, const std::vector<std::string>& entries) {
  Json all = Json::object();
  for (const std::string& entry : entries) {
    const size_t equals = entry.find('=');
    if (equals == std::string::npos) throw UsageError("gpu_bench collect: '" + entry + "' is not KEY=FILE");
    const std::filesystem::path file = entry.substr(equals + 1);
    all[entry.substr(0, equals)] = std::filesystem::exists(file) ? ReadJson(file) : Json();
  }
  WriteJson(out, all);
}

}  // namespace
}  // namespace nrff

int main(int argc, char** argv) {
  const std::vector<std::string> arguments(argv + 1, argv + argc);
  try {
    const std::string what = arguments.empty() ? "" : arguments[0];
    if (what == "measure" && arguments.size() == 4) {
      nrff::Measure(arguments[1], arguments[2], arguments[3]);
    } else if (what == "collect" && arguments.size() >= 2) {
      nrff::Collect(arguments[1], {arguments.begin() + 2, arguments.end()});
    } else {
      std::fprintf(stderr, "usage: gpu_bench measure SCENE MODEL OUT.json | collect OUT.json KEY=FILE...\n");
      return 2;
    }
  } catch (const nrff::Error& error) {
    std::fprintf(stderr, "gpu_bench: %s\n", error.what());
    return int(error.code());
  } catch (const std::exception& error) {  // of CUDA
    std::fprintf(stderr, "gpu_bench: %s\n", error.what());
    return int(nrff::ExitCode::kResource);
  }
  return 0;
}
