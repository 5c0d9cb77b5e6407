// nrff-ingest CAPTURE --out DIR | --probe
#include <CLI/CLI.hpp>
#include <algorithm>
#include <cstdio>
#include <string>
#include <thread>

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
  int n_threads = static_cast<int>(std::max(1u, std::thread::hardware_concurrency()));
  app.add_option("capture", capture, "Folder of photos, transforms.json, NSVF layout or COLMAP model with images")
      ->required();
  auto* where = app.add_option_group("what to do");
  where->require_option(1);
  where->add_option("--out", out, "Write the artifact to this folder");
  where->add_flag("--probe", probe, "Print what the capture is as one JSON object; write nothing");
  app.add_option("--threads", n_threads, "Photos decoded at once")
      ->check(CLI::Range(1, nrff::kMostThreads))
      ->capture_default_str();
  nrff::AddVerbosity(app);
  return nrff::StageMain(app, argc, argv, [&] {
    if (probe) {
      std::printf("%s\n", nrff::ProbeCapture(capture).dump().c_str());
      return;
    }
    nrff::ArtifactWriter artifact("ingest", out, nrff::GivenParams(app), {nrff::CaptureInput(capture)});
    nrff::Ingest(capture, n_threads, artifact);
    artifact.Commit();
  });
}
