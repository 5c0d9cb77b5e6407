#include "pipeline/stages.h"

#include <algorithm>
#include <map>
#include <string_view>

#include "pipeline/disk.h"
#include "pipeline/log.h"
#include "pipeline/stage.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr uint64_t kMebibyte = uint64_t(1) << 20;

struct Argument {
  std::string option;  // empty: positional
  std::string input;   // the stage whose artifact is its value
};

struct Stage {
  std::string name;
  std::string program, sub_command;
  std::vector<Argument> reads;         // artifacts, in the order of the command line
  std::vector<std::string> params;     // options that change its result
  std::vector<std::string> others;     // options that do not
  bool takes_threads = false;          // and keeps all cores busy
  uint64_t memory_bytes = 0;           // guess for a capture of ordinary size
  std::vector<std::string> kept = {};  // files that a run with photos added takes over; none: --base is not known
};

std::vector<Stage> StagesWithoutForceables() {
  return {
      {"ingest", "nrff-ingest", "", {}, {"frames", "masks"}, {}, false, 512 * kMebibyte, {"capture.json"}},
      {"sfm",
       "nrff-pose",
       "estimate",
       {{"--ingest", "ingest"}},
       {"seed", "sfm-image-size", "sfm-features", "camera-model"},
       {},
       true,
       2048 * kMebibyte,
       {"mapping"}},
      {"pose",
       "nrff-pose",
       "normalise",
       {{"--ingest", "ingest"}, {"--sfm", "sfm"}},
       {"max-image-size"},
       {},
       false,
       1024 * kMebibyte,
       {"scene.json"}},
      {"train",
       "nrff-train",
       "",
       {{"--scene", "pose"}},
       {"preset", "set", "directional", "steps", "budget", "seed", "device"},
       {},
       true,
       2048 * kMebibyte,
       {"checkpoint.safetensors"}},
      {"render",
       "nrff-render",
       "",
       {{"--scene", "pose"}, {"--model", "train"}},
       {"bit-depth"},
       {"device"},
       true,
       1024 * kMebibyte},
      {"eval", "nrff-eval", "", {{"--scene", "pose"}, {"--renders", "render"}}, {}, {"lpips"}, false, 1024 * kMebibyte},
      {"report", "nrff", "report", {}, {}, {}, false, 256 * kMebibyte},
  };
}

const std::vector<Stage>& Table() {
  static const std::vector<Stage> table = [] {
    std::vector<Stage> stages = StagesWithoutForceables();
    for (const Forceable& forceable : Forceables()) {
      for (Stage& stage : stages) {
        if (stage.name == forceable.stage) stage.params.emplace_back(forceable.option);
      }
    }
    return stages;
  }();
  return table;
}

// The report reads whatever was made before it.
constexpr std::string_view kReport = "report";

int OrderOf(const std::string& stage) {
  const auto& names = StageNames();
  return static_cast<int>(std::find(names.begin(), names.end(), stage) - names.begin());
}

int Last(const BranchRequest& request) {
  return request.until.empty() ? OrderOf(std::string(kReport)) : OrderOf(request.until);
}

// Those of the options that were given.
Params Given(const std::vector<std::string>& names, const BranchRequest& request) {
  Params given;
  for (const std::string& name : names) {
    const auto option = request.options.find(name);
    if (option != request.options.end()) given.insert(*option);
  }
  return given;
}

}  // namespace

std::string LpipsNetworkOf(const BranchRequest& request) {
  const auto given = request.options.find("lpips");
  if (given != request.options.end()) return given->second;
  const fs::path found = DefaultLpipsNetwork();
  return found.empty() ? needs::kNoLpips : found.string();
}

namespace {

void AddOptions(const Params& given, std::vector<std::string>& command) {
  for (const auto& [name, value] : given) command.insert(command.end(), {"--" + name, value});
}

// `extends`: ingest found the capture to extend what the workspace's base was made of.
Node MakeNode(const Stage& stage, const BranchRequest& request, const Machine& machine, bool posed,
              bool extends = false) {
  Node node;
  node.branch = request.name;
  node.stage = stage.name;
  node.artifact = request.workspace.Artifact(stage.name);
  node.log = request.workspace.Log(stage.name);
  node.cores = stage.takes_threads ? machine.cores : 1;
  node.memory_bytes = stage.memory_bytes;
  if (!request.from.empty() && OrderOf(stage.name) >= OrderOf(request.from)) node.when = When::kAlways;

  node.command = {(request.executables / stage.program).string()};
  if (!stage.sub_command.empty()) node.command.push_back(stage.sub_command);
  if (stage.name == kReport) {
    node.command.push_back(request.workspace.root().string());
    for (const std::string& before : StageNames()) {
      if (before != kReport && !(posed && before == "sfm")) node.inputs.push_back(request.name + "/" + before);
    }
  } else {
    if (stage.name == "ingest") {
      node.source = request.capture;
      node.command.push_back(request.capture.string());
    }
    for (const Argument& argument : stage.reads) {
      if (posed && argument.input == "sfm") continue;
      node.inputs.push_back(request.name + "/" + argument.input);
      node.command.insert(node.command.end(), {argument.option, request.workspace.Artifact(argument.input).string()});
    }
    if (!stage.kept.empty() && (extends || stage.name == "ingest") && request.workspace.HasBase(stage.name)) {
      node.bases.push_back(request.workspace.Base(stage.name));
      node.command.insert(node.command.end(), {"--base", node.bases.back().string()});
    }
    node.command.insert(node.command.end(), {"--out", node.artifact.string()});
  }
  node.params = Given(stage.params, request);
  Params others = Given(stage.others, request);
  AddOptions(node.params, node.command);
  if (stage.name == "eval") {
    // Always, so that the stage does not look for a network by itself.
    others["lpips"] = LpipsNetworkOf(request);
    node.params["lpips"] = LpipsParameter(others["lpips"]);
  }
  AddOptions(others, node.command);
  if (stage.takes_threads && !request.threads.empty()) {
    node.command.insert(node.command.end(), {"--threads", request.threads});
    node.cores = std::min(machine.cores, std::stoi(request.threads));
  }
  node.command.emplace_back("--verbose");  // the log keeps all; what is shown is chosen from it
  return node;
}

// Of a capture that brings its poses.
void WarnOfIdleOptions(const BranchRequest& request) {
  std::string idle;
  for (const auto& given : Given(Table()[size_t(OrderOf("sfm"))].params, request)) {
    const std::string& option = given.first;
    if (option == "seed") continue;  // of other stages, too
    const auto forceable =
        std::find_if(Forceables().begin(), Forceables().end(), [&](const Forceable& f) { return f.option == option; });
    idle.append(idle.empty() ? "" : ", ").append(forceable == Forceables().end() ? "--" + option : forceable->feature);
  }
  if (!idle.empty()) LogWarning(request.name + " brings its poses: none are estimated, whatever was said of " + idle);
}

std::vector<Node> NodesAfterIngest(const BranchRequest& request, const Machine& machine, bool posed,
                                   bool extends = false) {
  if (posed) WarnOfIdleOptions(request);
  std::vector<Node> nodes;
  for (const Stage& stage : Table()) {
    if (stage.name == "ingest" || (posed && stage.name == "sfm") || OrderOf(stage.name) > Last(request)) continue;
    nodes.push_back(MakeNode(stage, request, machine, posed, extends));
  }
  return nodes;
}

bool IsMadeOf(const Manifest& manifest, const std::vector<Manifest>& inputs) {
  return std::all_of(inputs.begin(), inputs.end(), [&](const Manifest& input) {
    return std::any_of(manifest.inputs.begin(), manifest.inputs.end(),
                       [&](const HashedPath& recorded) { return recorded.hash == input.ContentHash(); });
  });
}

}  // namespace

const std::vector<Forceable>& Forceables() {
  static const std::vector<Forceable> forceables = {
      {"exhaustive_matching", "sfm", "matching", "exhaustive", "selective"},
      {"gps_pairs", "sfm", "gps-pairs", "on", "off"},
      {"second_attempt", "sfm", "second-attempt", "on", "off"},
      {"refinement", "sfm", "refinement", "on", "off"},
      {"own_focal_lengths", "sfm", "own-focal-lengths", "on", "off"},
      {"undistortion", "pose", "undistortion", "on", "off"},
      {"contraction", "pose", "contraction", "on", "off"},
      {"sparse_depth", "train", "sparse-depth", "on", "off"},
      {"fine_levels", "train", "fine-levels", "on", "off"},
      {"exposure_correction", "train", "exposure-correction", "on", "off"},
      {"camera_correction", "train", "camera-correction", "on", "off"}};
  return forceables;
}

KeptFiles ExtendableStages(const Workspace& workspace) {
  RealDisk disk;
  std::map<std::string, Manifest> done;
  KeptFiles extendable;
  for (const Stage& stage : Table()) {
    if (stage.kept.empty()) continue;
    const ArtifactState state = disk.ReadArtifact(workspace.Artifact(stage.name));
    std::vector<Manifest> inputs;
    for (const Argument& argument : stage.reads) {
      if (done.contains(argument.input)) inputs.push_back(done.at(argument.input));
    }
    std::error_code error;
    const bool whole = state.manifest && state.manifest->version == Version() && inputs.size() == stage.reads.size() &&
                       IsMadeOf(*state.manifest, inputs) &&
                       std::all_of(stage.kept.begin(), stage.kept.end(), [&](const std::string& file) {
                         return fs::exists(workspace.Artifact(stage.name) / file, error);
                       });
    if (!whole) break;
    done.emplace(stage.name, *state.manifest);
    extendable.emplace_back(stage.name, stage.kept);
  }
  if (extendable.size() < 2) extendable.clear();  // ingest alone is nothing to go on from
  return extendable;
}

const std::vector<std::string>& StageNames() {
  static const std::vector<std::string> names = [] {
    std::vector<std::string> all;
    for (const Stage& stage : Table()) all.push_back(stage.name);
    return all;
  }();
  return names;
}

Node FirstNode(const BranchRequest& request, const Machine& machine) {
  Node ingest = MakeNode(Table().front(), request, machine, /*posed=*/false);
  ingest.expand = [request, machine](const Json& facts) {
    const bool posed = Get<bool>(facts, "posed", "what ingest says of " + request.name);
    return NodesAfterIngest(request, machine, posed, facts.value("extension", Json()).is_object());
  };
  return ingest;
}

std::vector<Node> BranchToRunAgain(const BranchRequest& request, const Machine& machine, bool posed,
                                   const std::vector<std::string>& stages) {
  std::vector<Node> nodes = NodesAfterIngest(request, machine, posed);
  nodes.insert(nodes.begin(), MakeNode(Table().front(), request, machine, posed));
  for (Node& node : nodes) {
    const bool again = std::find(stages.begin(), stages.end(), node.stage) != stages.end();
    node.when = again ? When::kAlways : When::kNever;
  }
  return nodes;
}

std::vector<Node> BranchOnPoses(const BranchRequest& request, const Machine& machine, bool posed) {
  std::vector<Node> nodes = NodesAfterIngest(request, machine, posed);
  nodes.insert(nodes.begin(), MakeNode(Table().front(), request, machine, posed));
  for (Node& node : nodes) {
    if (OrderOf(node.stage) <= OrderOf("pose")) node.when = When::kNever;
  }
  return nodes;
}

std::set<std::string> StageOptions() {
  std::set<std::string> options;
  for (const Stage& stage : Table()) {
    options.insert(stage.params.begin(), stage.params.end());
    options.insert(stage.others.begin(), stage.others.end());
  }
  return options;
}

std::vector<std::string> TrainingOptions(const BranchRequest& request) {
  const Stage& train = Table()[OrderOf("train")];
  std::vector<std::string> command = {(request.executables / train.program).string()};
  AddOptions(Given(train.params, request), command);
  return command;
}

fs::path ExecutableFolder() { return fs::canonical("/proc/self/exe").parent_path(); }

}  // namespace nrff
