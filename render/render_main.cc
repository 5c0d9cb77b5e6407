// nrff-render: a scene and a trained model → images of the held-out views, or of a camera path; or the error of a few
// of them against run time.

#include <ATen/ATen.h>

#include <functional>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "model/checkpoint.h"
#include "model/cuda/gpu_library.h"
#include "model/cuda/gpu_renderer.h"
#include "model/ray_batch.h"
#include "model/view_colours.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/log.h"
#include "pipeline/manifest.h"
#include "pipeline/stage.h"
#include "render/camera_path.h"
#include "render/compute.h"
#include "render/view_writer.h"
#include "render/work_precision.h"

namespace nrff {
namespace {

struct Options {
  std::filesystem::path scene_dir, model_dir, out;
  std::string path;  // "orbit", "spiral" or a file; empty: the capture's own views
  std::string split = "test";
  PathOptions frames;
  int bits = 8;
  bool work_precision = false;
  int n_views = 3;  // of work_precision
  std::string device = "auto";
  int n_threads = 0;
};

std::vector<View> CaptureViews(const Scene& scene, const std::string& split) {
  std::vector<View> views;
  for (const View& view : scene.views) {
    if (split == "all" || (view.split == Split::kTest) == (split == "test")) views.push_back(view);
  }
  if (views.empty()) {
    throw InputError("the scene " + scene.name + " has no " + split +
                     " views to render; choose another --split or a --path");
  }
  return views;
}

std::vector<View> PathViews(const Scene& scene, const Options& options) {
  if (options.path == "orbit") return OrbitPath(scene, options.frames);
  if (options.path == "spiral") return SpiralPath(scene, options.frames);
  return ReadPath(options.path, scene, options.frames);
}

// RenderSource::finish for the capture's views: each in the exposure that its photo has, or is thought to have.
std::function<void(const View&, RenderedImage&)> InTheirExposures(const Scene& scene, const LoadedModel& model) {
  std::vector<View> training;
  for (const int index : scene.ViewsOf(Split::kTrain)) training.push_back(scene.views[index]);
  ViewColours colours(*model.field, std::move(training));
  if (colours.empty()) return {};
  return [colours = std::move(colours), background = model.options.background](const View& view, RenderedImage& image) {
    CorrectColours(colours.Of(view), background, int64_t(image.opacity.size()), image.opacity.data(), image.rgb.data());
  };
}

void CorrectCameras(const LoadedModel& model, std::vector<View>& views) {
  for (View& view : views) view = model.cameras.Corrected(view);
}

void Render(const Options& options, const Params& params) {
  const Device device = ChooseDevice(options.device);
  const int n_threads = SetThreads(options.n_threads);
  const Manifest scene_manifest = RequireArtifact(options.scene_dir, "pose");
  const Manifest model_manifest = RequireArtifact(options.model_dir, "train");
  std::vector<HashedPath> inputs{ArtifactInput(options.scene_dir, scene_manifest),
                                 ArtifactInput(options.model_dir, model_manifest)};
  if (!options.path.empty() && options.path != "orbit" && options.path != "spiral") {
    inputs.push_back({EscapePath(options.path), HashFile(options.path), std::filesystem::file_size(options.path)});
  }
  const Scene scene = LoadScene(options.scene_dir);
  std::vector<View> views = options.path.empty() ? CaptureViews(scene, options.split) : PathViews(scene, options);
  const std::unique_ptr<LoadedModel> model = LoadModel(options.model_dir);
  if (options.path.empty()) CorrectCameras(*model, views);

  ArtifactWriter artifact("render", options.out, params, inputs, ArtifactWriter::kKeepPartial);
  artifact.SaveSeconds();
  RenderSource source{*model->field, model->occupancy, model->map, model->options, options.bits};
  std::optional<GpuRenderer> gpu;
  if (device.gpu) {
    gpu.emplace(device.gpu, *model->field, model->occupancy);
    source.render = [&](const View& view, const RenderOptions& with) { return gpu->Render(view, model->map, with); };
  }
  if (options.path.empty()) source.finish = InTheirExposures(scene, *model);  // a path's frames are all in one
  const RenderFacts facts = RenderViews(source, views, options.path.empty() ? "" : "path", artifact.dir());
  if (facts.n_kept > 0) LogInfo("kept " + std::to_string(facts.n_kept) + " views of an interrupted attempt");
  artifact.facts() = {{"n_views", facts.n_views},
                      {"seconds_per_view", facts.seconds_per_view},
                      {"samples_per_ray", facts.samples_per_ray},
                      {"threads", n_threads},
                      {"exposures", source.finish ? "of the nearest training views" : "the field's own"},
                      {"device", device.gpu ? "cuda" : "cpu"}};
  artifact.AddDecision(device.decision);
  artifact.AddOutput(kRendersFile);
  for (const char* layer : kRenderLayers) artifact.AddOutput(layer);
  artifact.Commit();
}

// The photo of a view, as training sees it.
TrueColours PhotoOf(const View& view, const ImagePack& pack, double background) {
  std::vector<int32_t> pixels;
  for (int y = 0; y < view.height; ++y) {
    for (int x = 0; x < view.width; ++x) pixels.insert(pixels.end(), {0, x, y});
  }
  const PixelSource source({view}, pack, background);
  const torch::Tensor target = source.At(at::tensor(pixels, torch::kInt).view({-1, 3})).target.contiguous();
  const float* values = target.const_data_ptr<float>();
  return {{values, values + target.numel()}};
}

void MeasureWorkPrecision(const Options& options, const Params& params) {
  const int n_threads = SetThreads(options.n_threads);
  const Manifest scene_manifest = RequireArtifact(options.scene_dir, "pose");
  const Manifest model_manifest = RequireArtifact(options.model_dir, "train");
  const Scene scene = LoadScene(options.scene_dir);
  const ImagePack pack(options.scene_dir);
  const std::unique_ptr<LoadedModel> model = LoadModel(options.model_dir);
  std::vector<View> held_out;
  for (const int index : scene.ViewsOf(Split::kTest)) held_out.push_back(scene.views[index]);
  if (held_out.empty()) {
    throw InputError("the scene " + scene.name + " has no held-out view with a pose, so that no error can be measured");
  }
  std::vector<View> views;
  std::vector<TrueColours> photos;
  const size_t n_views = std::min(held_out.size(), size_t(options.n_views));
  for (size_t i = 0; i < n_views; ++i) {
    views.push_back(held_out[i * held_out.size() / n_views]);
    photos.push_back(PhotoOf(views.back(), pack, model->options.background));
  }
  CorrectCameras(*model, views);
  ArtifactWriter artifact(
      "rendering", options.out, params,
      {ArtifactInput(options.scene_dir, scene_manifest), ArtifactInput(options.model_dir, model_manifest)});
  RenderSource source{*model->field, model->occupancy, model->map, model->options};
  source.finish = InTheirExposures(scene, *model);
  Json result = RenderingWorkPrecision(source, views, photos);
  result["threads"] = n_threads;
  result["width"] = views.front().width;
  result["height"] = views.front().height;
  WriteJson(artifact.dir() / "work_precision.json", {{"rendering", result}, {"quadrature", QuadratureWorkPrecision()}});
  artifact.facts() = {{"n_views", n_views}, {"threads", n_threads}};
  artifact.AddOutput("work_precision.json");
  artifact.Commit();
}

}  // namespace
}  // namespace nrff

int main(int argc, char** argv) {
  CLI::App app{
      "Renders a trained model: colour, depth, normals and opacity as PNG files.\n"
      "Example: nrff-render --scene work/fox/pose --model work/fox/train --out work/fox/render"};
  nrff::Options options;
  app.add_option("--scene", options.scene_dir, "artifact of nrff-pose normalise")->required()->type_name("DIR");
  app.add_option("--model", options.model_dir, "artifact of nrff-train")->required()->type_name("DIR");
  app.add_option("--out", options.out, "where the artifact is put")->required()->type_name("DIR");
  app.add_option("--threads", options.n_threads, "threads; 0: one per core")->check(CLI::NonNegativeNumber);
  app.add_option("--device", options.device, "where to compute")->check(CLI::IsMember({"auto", "cpu", "cuda"}));

  const char* group = nrff::kParameterGroup;
  auto* split = app.add_option("--split", options.split, "which of the capture's views to render (test)")->group(group);
  split->check(CLI::IsMember({"test", "train", "all"}));
  auto* path = app.add_option("--path", options.path, "orbit, spiral, or a file of poses instead")->group(group);
  path->excludes(split);
  const CLI::Range frames(1, 100000), pixels(1, 16384);
  app.add_option("--frames", options.frames.n_frames, "frames of the path (120)")
      ->group(group)
      ->needs(path)
      ->check(frames);
  app.add_option("--width", options.frames.width, "px (as the photos)")->group(group)->needs(path)->check(pixels);
  app.add_option("--height", options.frames.height, "px (as the photos)")->group(group)->needs(path)->check(pixels);
  app.add_option("--bit-depth", options.bits, "of the colours: 8 or 16 (8)")
      ->group(group)
      ->check(CLI::IsMember({8, 16}));
  auto* work_precision = app.add_flag("--work-precision", options.work_precision,
                                      "error against time of what rendering leaves out, instead of images")
                             ->group(group)
                             ->excludes(path)
                             ->excludes(split);
  app.add_option("--views", options.n_views, "held-out views for that (3)")
      ->group(group)
      ->needs(work_precision)
      ->check(CLI::Range(1, 1000));
  nrff::AddVerbosity(app);
  return nrff::StageMain(app, argc, argv, [&] {
    const auto run = options.work_precision ? nrff::MeasureWorkPrecision : nrff::Render;
    run(options, nrff::GivenParams(app));
  });
}
