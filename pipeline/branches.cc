#include "pipeline/branches.h"

#include <algorithm>
#include <cmath>
#include <set>
#include <sstream>

#include "pipeline/commands.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/log.h"
#include "pipeline/scene.h"
#include "pipeline/stage.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

// `refusal`: " is no …; give ", say.
std::string CheckWord(const std::string& text, const std::vector<std::string>& words, const std::string& refusal) {
  if (std::find(words.begin(), words.end(), text) != words.end()) return {};
  std::string all;
  for (const std::string& word : words) all += (all.empty() ? "" : ", ") + word;
  return "'" + text + "'" + refusal + all;
}

std::string CheckStage(const std::string& text) {
  return CheckWord(text, StageNames(), " is no stage; the stages are ");
}

// The form alone: what keys there are, the training program knows.
std::string CheckSettings(const std::string& text) {
  std::istringstream words(text);
  if (text.find_first_not_of(' ') == std::string::npos) return "is empty; give field.KEY=VALUE or train.KEY=VALUE";
  for (std::string word; words >> word;) {
    const size_t dot = word.find('.'), equals = word.find('=');
    const std::string group = word.substr(0, dot);
    const bool fits = (group == "field" || group == "train") && equals != std::string::npos && dot + 1 < equals &&
                      equals + 1 < word.size();
    if (!fits) return "'" + word + "' is not of the form field.KEY=VALUE or train.KEY=VALUE";
  }
  return {};
}

std::string CheckImageSize(const std::string& text) { return CheckRange(text, kLeastMaxImageSize, kMostMaxImageSize); }

std::string CheckMasks(const std::string& text) {
  return CheckWord(text, MaskMeanings(), " is nothing that masks can mean; give one of ");
}

std::string CheckCameraModel(const std::string& text) {
  return CheckWord(text, CameraModelChoices(), " is no camera model; give one of ");
}

std::string CheckFrames(const std::string& text) { return CheckRange(text, kLeastFramesAsked, kMostFramesAsked); }

std::string CheckBitDepth(const std::string& text) {
  return text == "8" || text == "16" ? "" : "'" + text + "' is no bit depth; give 8 or 16";
}

std::string CheckThreads(const std::string& text) { return CheckRange(text, 1, kMostThreads); }

std::string CheckFeature(const std::string& text) {
  std::vector<std::string> features;
  for (const Forceable& forceable : Forceables()) features.emplace_back(forceable.feature);
  return CheckWord(text, features, " is nothing that can be forced; that can be ");
}

void AddForced(const std::string& feature, bool needed, Params& params) {
  for (const Forceable& forceable : Forceables()) {
    if (feature != forceable.feature) continue;
    const std::string word = needed ? forceable.needed : forceable.left_out;
    const auto [entry, is_new] = params.emplace(forceable.option, word);
    if (!is_new && entry->second != word) throw UsageError("--need and --leave-out both name " + feature);
  }
}

Params GivenOptions(const BranchOptions& options) {
  Params params;
  const auto add = [&](const char* name, const std::string& value) {
    if (!value.empty()) params[name] = value;
  };
  add("preset", options.preset);
  add("set", options.set);
  add("directional", options.directional);
  for (const std::string& feature : options.need) AddForced(feature, true, params);
  for (const std::string& feature : options.leave_out) AddForced(feature, false, params);
  add("steps", options.steps);
  add("seed", options.seed);
  add("device", options.device);
  add("frames", options.frames);
  add("masks", options.masks);
  add("camera-model", options.camera_model);
  add("max-image-size", options.max_image_size);
  add("bit-depth", options.bit_depth);
  add("lpips", options.lpips.empty() || options.lpips == needs::kNoLpips
                   ? options.lpips
                   : fs::absolute(options.lpips).lexically_normal().string());
  if (!options.budget.empty()) {
    const double seconds = ParseDuration(options.budget, "--budget");
    add("budget", std::to_string(std::llround(seconds)) + "s");
  }
  params.insert(options.defaults.begin(), options.defaults.end());
  return params;
}

// An earlier version may have written options that this one does not have.
void ForgetUnknown(const std::string& workspace, Params& options) {
  const std::set<std::string> known = StageOptions();
  std::erase_if(options, [&](const auto& option) {
    if (known.contains(option.first)) return false;
    LogWarning(workspace + " remembers --" + option.first + " " + option.second +
               ", which this version does not have; it is left out");
    return true;
  });
}

std::string BranchName(const Workspace& workspace, std::set<std::string>& taken) {
  const std::string name = EscapePath(fs::weakly_canonical(workspace.root()).filename());
  std::string unique = name;
  for (int n = 2; !taken.insert(unique).second; ++n) unique = name + "-" + std::to_string(n);
  return unique;
}

// Folders are given with and without a slash at the end, which makes a difference to std::filesystem.
fs::path Folder(const std::string& given) {
  const fs::path path = fs::path(given).lexically_normal();
  return path.has_filename() || !path.has_relative_path() ? path : path.parent_path();
}

}  // namespace

void AddTargetOption(CLI::App& command, BranchOptions& options) {
  command.add_option("CAPTURE", options.targets, "Folder of photos, video, posed capture, workspace")
      ->required()
      ->type_name("");
}

void AddBranchOptions(CLI::App& command, BranchOptions& options) {
  const auto add = [&](const char* names, std::string& value, const char* type, const std::string& text) {
    return command.add_option(names, value, text)->type_name(type);
  };
  const auto default_of = [&](const char* name, int otherwise) {
    const auto found = options.defaults.find(name);
    return found == options.defaults.end() ? std::to_string(otherwise) : found->second;
  };
  add("--workspace,-w", options.workspace, "DIR",
      "Where everything goes (default: " + options.folder + (options.in_folder ? ")" : "/NAME)"));
  add("--preset", options.preset, "NAME", "paper, small or tiny (default: by the budget)");
  add("--set", options.set, "SETTINGS", "Changes of the preset, as 'field.levels=10'")->check(CheckSettings);
  add("--directional", options.directional, "NAME", "Encoding of directions: ree (default), ide, pe, none");
  auto* budget = add("--budget", options.budget, "TIME", "Train the best model in this time: 90s, 10m, 1h");
  budget->check(
      [](const std::string& text) { return std::string(text.empty() ? "give a time, as 90s, 10m, 1h" : ""); });
  add("--steps", options.steps, "N", "Training steps; not with --budget")->check(CheckPositive)->excludes(budget);
  add("--frames", options.frames, "N", "Of each video (default: as its picture moves)")->check(CheckFrames);
  add("--masks", options.masks, "WHAT", "Masks mean: ignore (default), background; or off")->check(CheckMasks);
  add("--camera-model", options.camera_model, "NAME", "COLMAP's, of all lenses (default: as photos need)")
      ->check(CheckCameraModel);
  add("--max-image-size", options.max_image_size, "PX",
      "Shrink photos to this side (default: " + default_of("max-image-size", kMaxImageSize) + ")")
      ->check(CheckImageSize);
  add("--bit-depth", options.bit_depth, "N",
      "Of rendered colours: 8 or 16 (default: " + default_of("bit-depth", 8) + ")")
      ->check(CheckBitDepth);
  const auto add_forced = [&](const char* name, std::vector<std::string>& features, const char* text) {
    command.add_option(name, features, text)
        ->type_name("FEATURE")
        ->expected(1)
        ->take_all()
        ->allow_extra_args(false)
        ->check(CheckFeature);
  };
  add_forced("--need", options.need, "Use what `nrff plan` would leave out");
  add_forced("--leave-out", options.leave_out, "Leave out what `nrff plan` would use");
  add("--lpips", options.lpips, "FILE", "Score with this LPIPS network too; none: without")
      ->check(
          [](const std::string& text) { return text == needs::kNoLpips ? std::string() : CLI::ExistingFile(text); });
  add("--device", options.device, "NAME", "auto, cpu or cuda")->check(CheckDevice);
  add("--threads", options.threads, "N", "Threads of one stage (default: all cores)")->check(CheckThreads);
  add("--seed", options.seed, "N", "Of everything random")->check(CheckWhole);
  add("--from", options.from, "STAGE", "Run this stage and what follows it again")->check(CheckStage);
  add("--until", options.until, "STAGE", "Stop after this stage")->check(CheckStage);
  command.add_flag("--force", options.force, "Run all stages again");
}

std::vector<BranchRequest> MakeBranches(const BranchOptions& options) {
  const auto& names = StageNames();
  const std::string from = options.force ? names.front() : options.from;
  if (!from.empty() && !options.until.empty() &&
      std::find(names.begin(), names.end(), from) > std::find(names.begin(), names.end(), options.until)) {
    throw UsageError("--from " + from + " comes after --until " + options.until + ": nothing would run");
  }
  const Params given = GivenOptions(options);
  const bool one = options.targets.size() == 1 && !options.in_folder;
  const fs::path folder = options.workspace.empty() ? fs::path(options.folder) : Folder(options.workspace);
  if (!one && Workspace(folder).Exists()) {
    throw UsageError(EscapePath(folder) + " is the workspace of one capture: give a folder that can hold several");
  }

  std::vector<BranchRequest> requests;
  std::set<fs::path> captures, workspaces;
  std::set<std::string> branches;
  for (const std::string& target : options.targets) {
    Workspace workspace(Folder(target));
    BranchRequest request{"", workspace, {}, ExecutableFolder(), given, options.threads, from, options.until};
    if (workspace.Exists()) {
      if (!options.workspace.empty()) {
        throw UsageError("--workspace cannot be given with " + target + ", which is a workspace");
      }
      Workspace::Marker marker = workspace.ReadMarker();
      ForgetUnknown(target, marker.options);
      request.capture = marker.capture;
      // Steps and a budget exclude each other: the one given now replaces the other one given before.
      if (given.contains("steps")) marker.options.erase("budget");
      if (given.contains("budget")) marker.options.erase("steps");
      request.options.merge(marker.options);
    } else {
      request.capture = CapturePath(target);
      const bool named = one && !options.workspace.empty();
      request.workspace = named ? Workspace(folder) : WorkspaceFor(request.capture, folder, workspaces);
    }
    // What happens without: a model remembered is none any more.
    if (request.options.contains("camera-model") && request.options.at("camera-model") == "auto")
      request.options.erase("camera-model");
    if (!captures.insert(request.capture).second) throw UsageError(EscapePath(request.capture) + " is given twice");
    workspaces.insert(request.workspace.root());
    request.name = BranchName(request.workspace, branches);
    requests.push_back(std::move(request));
  }
  return requests;
}

std::vector<std::string> ForceableFeatures(const std::vector<Node>& nodes) {
  std::vector<std::string> features;
  for (const Forceable& forceable : Forceables()) {
    if (std::any_of(nodes.begin(), nodes.end(), [&](const Node& node) { return node.stage == forceable.stage; })) {
      features.emplace_back(forceable.feature);
    }
  }
  return features;
}

std::optional<bool> ForcedDecision(const BranchRequest& request, const std::string& feature) {
  for (const Forceable& forceable : Forceables()) {
    const auto given = request.options.find(forceable.option);
    if (feature == forceable.feature && given != request.options.end()) return given->second == forceable.needed;
  }
  return {};
}

Json JsonFrom(Executor& executor, std::vector<std::string> command) {
  const std::string program = fs::path(command.front()).filename().string();
  std::string output;
  Job job;
  job.command = std::move(command);
  job.on_line = [&](const std::string& line) {
    if (line.compare(0, 9, "warning: ") != 0) output += line + "\n";
  };
  const JobResult result = RunJob(executor, std::move(job));
  if (const int signal = executor.StopSignal(); signal != 0) {
    throw Error(static_cast<ExitCode>(128 + signal), "stopped by signal " + std::to_string(signal));
  }
  if (result.exit_code != 0) throw Error(static_cast<ExitCode>(result.exit_code), result.error);
  Json facts = Json::parse(output, nullptr, /*allow_exceptions=*/false);
  if (!facts.is_object()) throw ExternalToolError(program + " answered with something that is not JSON");
  return facts;
}

namespace {

// The JSON object that a stage's --probe answers with. Throws Error with the stage's own sentence and exit code.
Json Probe(Executor& executor, std::vector<std::string> command) {
  command.insert(command.end(), {"--probe", "--quiet"});
  return JsonFrom(executor, std::move(command));
}

}  // namespace

Json ProbeCapture(Executor& executor, const BranchRequest& request) {
  return Probe(executor, {(request.executables / "nrff-ingest").string(), request.capture.string()});
}

Json ProbeExtension(Executor& executor, const BranchRequest& request) {
  Json extension = {{"extension", nullptr}, {"why_anew", nullptr}};
  if (request.from == StageNames().front() || ExtendableStages(request.workspace).empty()) return extension;
  const std::string ingest = request.workspace.Artifact("ingest").string();
  const std::optional<Manifest> made = ReadManifest(ingest);
  if (!made || made->inputs.empty() || made->facts.value("n_videos", 0) > 0) return extension;  // never extended
  if (made->inputs.front().hash == HashTree(request.capture)) return extension;
  const Json facts =
      Probe(executor, {(request.executables / "nrff-ingest").string(), request.capture.string(), "--base", ingest});
  for (auto& [key, value] : extension.items()) value = facts.value(key, Json());
  return extension;
}

Json ProbeTraining(Executor& executor, const BranchRequest& request) {
  return Probe(executor, TrainingOptions(request));
}

fs::path CommonFolder(const std::vector<Workspace>& workspaces) {
  const auto folder = [](const Workspace& workspace) {
    return fs::absolute(workspace.root()).lexically_normal().parent_path();
  };
  for (const Workspace& workspace : workspaces) {
    if (folder(workspace) == folder(workspaces.front())) continue;
    throw UsageError(EscapePath(workspaces.front().root()) + " and " + EscapePath(workspace.root()) +
                     " lie in different folders: workspaces that share a report have to lie in one");
  }
  const fs::path parent = workspaces.front().root().parent_path();
  return parent.empty() ? fs::path(".") : parent;
}

BranchRequest BranchOf(const Workspace& workspace) {
  std::set<std::string> none;
  const Workspace::Marker marker = workspace.ReadMarker();
  return {BranchName(workspace, none), workspace, marker.capture, ExecutableFolder(), marker.options, "", "", ""};
}

}  // namespace nrff
