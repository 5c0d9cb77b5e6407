// nrff-ingest CAPTURE --out DIR | --probe
#include <CLI/CLI.hpp>
#include <algorithm>
#include <cstdio>
#include <string>
#include <thread>
#include <vector>

#include "pipeline/extension.h"
#include "pipeline/manifest.h"
#include "pipeline/stage.h"
#include "sfm/ingest.h"

int main(int argc, char** argv) {
  CLI::App app(
      "Recognises a capture, checks its photos and freezes the hold-out.\n"
      "Example: nrff-ingest photos/ --out work/photos/ingest",
      "nrff-ingest");
  app.set_version_flag("--version", nrff::Version());
  std::string capture, out;
  bool probe = false;
  nrff::IngestOptions options;
  options.n_threads = static_cast<int>(std::max(1u, std::thread::hardware_concurrency()));
  app.add_option("capture", capture,
                 "Folder of photos, video, transforms.json, NSVF layout or COLMAP model with images")
      ->required();
  auto* where = app.add_option_group("what to do");
  where->require_option(1);
  where->add_option("--out", out, "Write the artifact to this folder");
  where->add_flag("--probe", probe, "Print what the capture is as one JSON object; write nothing");
  app.add_option("--base", options.base, "Artifact of the same capture with fewer photos, to be extended");
  const auto set_masks = [&](const std::string& meaning) {
    options.without_masks = meaning == "off";
    if (meaning == "ignore") options.masks = nrff::Masks::kIgnore;
    if (meaning == "background") options.masks = nrff::Masks::kBackground;
  };
  app.add_option_function<std::string>("--masks", set_masks, "What masks leave out: ignore (default), background; off")
      ->group(nrff::kParameterGroup)
      ->check(CLI::IsMember(nrff::MaskMeanings()));
  app.add_option("--frames", options.frames, "Frames of each video (default: as its picture moves)")
      ->group(nrff::kParameterGroup)
      ->check(CLI::Range(nrff::kLeastFramesAsked, nrff::kMostFramesAsked));
  app.add_option("--threads", options.n_threads, "Photos decoded at once")
      ->check(CLI::Range(1, nrff::kMostThreads))
      ->capture_default_str();
  nrff::AddVerbosity(app);
  return nrff::StageMain(app, argc, argv, [&] {
    if (probe) {
      std::printf("%s\n", nrff::ProbeCapture(capture, options.base).dump().c_str());
      return;
    }
    std::vector<nrff::HashedPath> inputs = {nrff::CaptureInput(capture)};
    if (!options.base.empty()) inputs.push_back(nrff::BaseInput(options.base));
    nrff::ArtifactWriter artifact("ingest", out, nrff::GivenParams(app), inputs);
    nrff::Ingest(capture, options, artifact);
    artifact.Commit();
  });
}
