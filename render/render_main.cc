// nrff-render: a scene and a trained model → images of the held-out views, or of a camera path.

#include <string>
#include <vector>

#include "model/checkpoint.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/log.h"
#include "pipeline/manifest.h"
#include "pipeline/stage.h"
#include "render/camera_path.h"
#include "render/compute.h"
#include "render/view_writer.h"

namespace nrff {
namespace {

struct Options {
  std::filesystem::path scene_dir, model_dir, out;
  std::string path;  // "orbit", "spiral" or a file; empty: the capture's own views
  std::string split = "test";
  PathOptions frames;
  int bits = 8;
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

void Render(const Options& options, const Params& params) {
  const Decision device = ChooseDevice(options.device);
  const int n_threads = SetThreads(options.n_threads);
  const Manifest scene_manifest = RequireArtifact(options.scene_dir, "pose");
  const Manifest model_manifest = RequireArtifact(options.model_dir, "train");
  std::vector<HashedPath> inputs{ArtifactInput(options.scene_dir, scene_manifest),
                                 ArtifactInput(options.model_dir, model_manifest)};
  if (!options.path.empty() && options.path != "orbit" && options.path != "spiral") {
    inputs.push_back({EscapePath(options.path), HashFile(options.path), std::filesystem::file_size(options.path)});
  }
  const Scene scene = LoadScene(options.scene_dir);
  const std::vector<View> views = options.path.empty() ? CaptureViews(scene, options.split) : PathViews(scene, options);
  const std::unique_ptr<LoadedModel> model = LoadModel(options.model_dir);

  ArtifactWriter artifact("render", options.out, params, inputs, ArtifactWriter::kKeepPartial);
  artifact.SaveSeconds();
  const RenderFacts facts = RenderViews({*model->field, model->occupancy, model->map, model->options, options.bits},
                                        views, options.path.empty() ? "" : "path", artifact.dir());
  if (facts.n_kept > 0) LogInfo("kept " + std::to_string(facts.n_kept) + " views of an interrupted attempt");
  artifact.facts() = {{"n_views", facts.n_views},
                      {"seconds_per_view", facts.seconds_per_view},
                      {"samples_per_ray", facts.samples_per_ray},
                      {"threads", n_threads},
                      {"device", "cpu"}};
  artifact.AddDecision(device);
  artifact.AddOutput(kRendersFile);
  for (const char* layer : kRenderLayers) artifact.AddOutput(layer);
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
  nrff::AddVerbosity(app);
  return nrff::StageMain(app, argc, argv, [&] { nrff::Render(options, nrff::GivenParams(app)); });
}
