// Stands in for every stage in the driver's tests: reads and writes artifacts as they do, in no time. Which stage it is
// it takes from the last part of --out. The environment says how it behaves:
//   FAKE_LOG           a file that gets a line "BRANCH/STAGE" for every run, and "BRANCH/STAGE+" where it has a base
//   FAKE_FAIL          "BRANCH/STAGE": that one ends with exit code 3 and an error
//   FAKE_HANG          "BRANCH/STAGE": that one waits for a signal, after a line "hanging" in FAKE_LOG
//   FAKE_PAYLOAD       text that ingest's payload is made from, beside the capture's content
//   FAKE_POSED         set: the capture brings its poses
#include <unistd.h>

#include <cstdlib>
#include <fstream>
#include <iostream>
#include <map>
#include <set>

#include "pipeline/extension.h"
#include "pipeline/files.h"
#include "pipeline/log.h"
#include "pipeline/manifest.h"
#include "pipeline/progress.h"
#include "pipeline/stage.h"

namespace fs = std::filesystem;

namespace {

std::string Environment(const char* name) {
  const char* value = std::getenv(name);
  return value == nullptr ? "" : value;
}

void Note(const std::string& line) {
  const std::string path = Environment("FAKE_LOG");
  if (!path.empty()) std::ofstream(path, std::ios::app) << line << std::endl;
}

const std::set<std::string> kParams = {"preset",
                                       "steps",
                                       "budget",
                                       "seed",
                                       "max-image-size",
                                       "undistortion",
                                       "contraction",
                                       "matching",
                                       "gps-pairs",
                                       "second-attempt",
                                       "refinement",
                                       "own-focal-lengths",
                                       "camera-model",
                                       "set",
                                       "fine-levels",
                                       "sparse-depth",
                                       "bit-depth",
                                       "sfm-image-size",
                                       "sfm-features",
                                       "directional",
                                       "exposure-correction",
                                       "camera-correction"};
// Files of the capture by name, and their hashes.
std::map<std::string, std::string> FilesOf(const fs::path& capture) {
  std::map<std::string, std::string> files;
  for (const fs::path& file : nrff::ListFiles(capture)) {
    files[file.lexically_relative(capture).string()] = nrff::HashFile(file);
  }
  return files;
}

// As ingest says it of a base: files may be added, none changed.
void SetExtension(const fs::path& capture, const fs::path& base, nrff::Json& facts) {
  const auto earlier = nrff::ReadJson(base / "capture.json").at("files").get<std::map<std::string, std::string>>();
  const auto now = FilesOf(capture);
  facts["extension"] = facts["why_anew"] = nullptr;
  for (const auto& [name, hash] : earlier) {
    const auto found = now.find(name);
    if (found == now.end() || found->second != hash) facts["why_anew"] = name + " was changed";
  }
  if (!facts["why_anew"].is_null()) return;
  facts["extension"] = {{"n_earlier", earlier.size()}, {"n_added", now.size() - earlier.size()}};
}

const std::set<std::string> kInputs = {"ingest", "sfm", "scene", "model", "renders"};

}  // namespace

int main(int argc, char** argv) {
  std::map<std::string, std::string> options;
  std::string positional;
  for (int i = 1; i < argc; ++i) {
    const std::string argument = argv[i];
    if (argument.compare(0, 2, "--") != 0) {
      positional = argument;
    } else if (argument == "--verbose" || argument == "--quiet" || argument == "--probe" ||
               argument == "--work-precision" || argument == "--json") {
      options[argument.substr(2)] = "";
    } else if (i + 1 < argc) {
      options[argument.substr(2)] = argv[++i];
    }
  }
  if (positional == "compare") {
    const bool estimated = options["estimated"].find("/work-precision/poses/") != std::string::npos;
    if (!estimated || options["truth"].find("/work-precision/") != std::string::npos) return 2;
    std::cout << nrff::Json({{"position", {{"median", 0.01}}},
                             {"rotation_deg", {{"median", 0.5}}},
                             {"relative_deg", {{"auc", {{"5", 0.75}}}}}})
                     .dump()
              << std::endl;
    return 0;
  }
  // A folder of photos alone brings no poses.
  const bool posed = !Environment("FAKE_POSED").empty() && fs::path(positional).filename() != "images";
  nrff::Json facts = {{"posed", posed}, {"kind", "photos"}, {"n_images", 8}, {"ordered", true}};
  if (options.contains("probe") && fs::path(argv[0]).filename() == "nrff-train") {
    if (options["preset"] == "huge") {
      std::cerr << "error: --preset 'huge' is not known" << std::endl;
      return 2;
    }
    std::cout << nrff::Json({{"preset", "small"}, {"device", "cpu"}, {"steps", 8000}, {"budget_seconds", 0}}).dump()
              << std::endl;
    return 0;
  }
  if (options.contains("base") && posed == false && fs::exists(fs::path(options["base"]) / "capture.json")) {
    SetExtension(positional, options["base"], facts);
  }
  if (options.contains("probe")) {
    std::cout << facts.dump() << std::endl;
    return 0;
  }
  const fs::path out = options.at("out");
  const std::string stage = out.filename().string();
  const std::string id = out.parent_path().filename().string() + "/" + stage;
  Note(id);
  if (Environment("FAKE_FAIL") == id) {
    std::cerr << "error: " << id << " was told to fail" << std::endl;
    return 3;
  }
  if (Environment("FAKE_HANG") == id) {
    Note("hanging " + std::to_string(getpid()));
    while (true) pause();
  }

  nrff::Params params;
  std::vector<nrff::HashedPath> inputs;
  std::string payload = stage;
  for (const auto& [name, value] : options) {
    if (kParams.contains(name)) {
      params[name] = value;
      payload += name + value;
    } else if (name == "lpips") {
      params[name] = nrff::LpipsParameter(value);
      payload += params[name];
    } else if (name == "base") {
      Note(id + "+");
      inputs.push_back(nrff::BaseInput(value));
      payload += inputs.back().hash;
    } else if (kInputs.contains(name)) {
      inputs.push_back(nrff::ArtifactInput(value, *nrff::ReadManifest(value)));
      payload += nrff::ReadFile(fs::path(value) / "payload");
    }
  }
  if (stage == "ingest") {
    inputs.insert(inputs.begin(), {nrff::EscapePath(positional), nrff::HashTree(positional), 0});
    payload += inputs.front().hash + Environment("FAKE_PAYLOAD");
  }
  if (options.contains("work-precision")) params["work-precision"] = "true";
  nrff::Progress progress("working", 2, "steps");
  progress.Update(1, "half");
  nrff::LogInfo("halfway through " + id);
  nrff::ArtifactWriter artifact(stage, out, params, inputs);
  nrff::WriteFileAtomically(artifact.dir() / "payload", nrff::HashBytes(payload));
  artifact.AddOutput("payload");
  if (stage == "ingest") {
    const std::string photo = fs::exists(fs::path(positional) / "images") ? "images/photo.jpg" : "photo.jpg";
    nrff::WriteJson(
        artifact.dir() / "capture.json",
        {{"root", nrff::EscapePath(positional)}, {"images", {{{"path", photo}}}}, {"files", FilesOf(positional)}});
  }
  if (stage == "sfm") fs::create_directories(artifact.dir() / "mapping");
  if (stage == "pose") nrff::WriteJson(artifact.dir() / "scene.json", nrff::Json::object());
  if (stage == "train") nrff::WriteFileAtomically(artifact.dir() / "checkpoint.safetensors", "of " + id);
  if (options.contains("path")) {
    fs::create_directories(artifact.dir() / "rgb");
    nrff::WriteFileAtomically(artifact.dir() / "rgb" / "000000.png", "no picture");
    artifact.AddOutput("rgb");
  }
  if (options.contains("work-precision")) {
    const nrff::Json point = {{"value", 1},      {"seconds", 0.1},       {"rmse", 0},           {"most", 0},
                              {"psnr", nullptr}, {"samples_per_ray", 9}, {"shaded_per_ray", 2}, {"chosen", true}};
    const nrff::Json family = {{"family", "step"}, {"points", {point}}};
    const nrff::Json quadrature = {{"density", "linear"}, {"points", {{{"n_samples", 1}, {"error", 0.5}}}}};
    nrff::WriteJson(artifact.dir() / "work_precision.json",
                    {{"rendering",
                      {{"n_views", 3},
                       {"width", 20},
                       {"height", 10},
                       {"threads", 2},
                       {"reference_seconds", 1.5},
                       {"families", {family}}}},
                     {"quadrature", {quadrature}},
                     {"scoring",
                      {{{"width", 8},
                        {"height", 6},
                        {"chosen", true},
                        {"psnr", 30.5},
                        {"ssim", nullptr},
                        {"lpips", nullptr},
                        {"seconds", {{"psnr", 0.25}, {"ssim", nullptr}, {"lpips", nullptr}}}}}}});
    artifact.AddOutput("work_precision.json");
  }
  artifact.facts() = facts;
  if (stage == "eval") artifact.facts().update({{"psnr", 21.5}, {"ssim", 0.75}});
  if (stage == "train") {
    artifact.facts().update(
        {{"steps", options.contains("steps") ? std::stoi(options["steps"]) : 8000},
         {"preset", "small"},
         {"n_parameters", 1000},
         {"settings", {{"field", {{"levels", 4}, {"base_resolution", 16}, {"max_resolution", 64}}}}}});
  }
  if (stage == "train" && options.contains("budget")) {
    artifact.facts()["seconds_training"] = std::stod(options["budget"]);
  }
  if (stage == "pose")
    artifact.AddDecision({"undistortion", false, "largest displacement 0.03 px", "0.1 px", "no lens"});
  artifact.Commit();
  progress.Done();
  return 0;
}
