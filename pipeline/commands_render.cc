// nrff render: a camera path through a trained scene, as MP4 or PNG frames.
#include <unistd.h>

#include <iostream>

#include "pipeline/branches.h"
#include "pipeline/commands.h"
#include "pipeline/console.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/local_executor.h"
#include "pipeline/manifest.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr char kProgressLabel[] = "render";

struct RenderOptions {
  std::string workspace, path = "orbit", output_path, frames = "120", fps = "30", width, height, device, threads;
  OutputOptions output;
};

bool IsKind(const std::string& path) { return path == "orbit" || path == "spiral"; }

// The path's name: the kind itself, or the file's.
std::string PathName(const std::string& path) { return IsKind(path) ? path : fs::path(path).stem().string(); }

std::string CheckPath(const std::string& path) {
  std::error_code absent;
  if (IsKind(path) || fs::is_regular_file(path, absent)) return {};
  return "'" + path + "' is neither orbit nor spiral nor a file of poses (JSON; README.md describes it)";
}

std::vector<std::string> RenderCommand(const RenderOptions& options, const Workspace& workspace, const fs::path& out) {
  std::vector<std::string> command = {(ExecutableFolder() / "nrff-render").string(),
                                      "--scene",
                                      workspace.Artifact("pose").string(),
                                      "--model",
                                      workspace.Artifact("train").string(),
                                      "--out",
                                      out.string(),
                                      "--path",
                                      options.path,
                                      "--frames",
                                      options.frames,
                                      "--verbose"};
  const auto add = [&](const char* name, const std::string& value) {
    if (!value.empty()) command.insert(command.end(), {name, value});
  };
  add("--width", options.width);
  add("--height", options.height);
  add("--device", options.device);
  add("--threads", options.threads);
  return command;
}

void RunOrThrow(LocalExecutor& executor, Job job) {
  const JobResult result = RunJob(executor, std::move(job));
  if (const int signal = executor.StopSignal(); signal != 0) {
    throw Error(static_cast<ExitCode>(128 + signal), "stopped by signal " + std::to_string(signal));
  }
  if (result.exit_code != 0) throw Error(static_cast<ExitCode>(result.exit_code), result.error);
}

void RenderFrames(const RenderOptions& options, const Workspace& workspace, const fs::path& out) {
  const Verbosity verbosity = options.output.verbosity();
  ProgressView view(std::cerr, [] { return TerminalColumns(STDERR_FILENO); });
  LocalExecutor executor([&view] { view.Tick(); });
  Job job;
  job.command = RenderCommand(options, workspace, out);
  job.log = workspace.Log("render-" + out.filename().string());
  job.on_line = [&](const std::string& line) {
    if (IsShown(line, verbosity)) view.Print(EscapePath(line));
  };
  job.on_progress = [&](const ProgressUpdate& update) { view.Update(kProgressLabel, update); };
  if (verbosity != Verbosity::kQuiet) view.Begin(kProgressLabel);
  RunOrThrow(executor, std::move(job));
}

// H.264 wants even sides: an odd one loses its last row or column.
void EncodeMp4(const fs::path& frames, const std::string& fps, const fs::path& mp4, const fs::path& log) {
  fs::path partial = mp4;
  partial += ".partial";
  Job job;
  job.command = {"ffmpeg",
                 "-nostdin",
                 "-y",
                 "-loglevel",
                 "error",
                 "-framerate",
                 fps,
                 "-i",
                 (frames / "%06d.png").string(),
                 "-vf",
                 "crop=trunc(iw/2)*2:trunc(ih/2)*2",
                 "-c:v",
                 "libx264",
                 "-pix_fmt",
                 "yuv420p",
                 "-movflags",
                 "+faststart",
                 "-f",
                 "mp4",
                 partial.string()};
  job.log = log;
  std::string last_line;
  job.on_line = [&](const std::string& line) { last_line = line; };
  try {
    LocalExecutor executor;
    RunOrThrow(executor, std::move(job));
  } catch (const Error& error) {
    std::error_code ignored;
    fs::remove(partial, ignored);
    if (static_cast<int>(error.code()) > 128) throw;
    throw ExternalToolError("ffmpeg did not make " + EscapePath(mp4) + " (" +
                            (last_line.empty() ? error.what() : EscapePath(last_line)) + "); the frames are in " +
                            EscapePath(frames) + "; install it with `apt-get install ffmpeg` if it is missing");
  }
  fs::rename(partial, mp4);
}

bool IsFrame(const fs::path& file) {
  const std::string stem = file.stem().string();
  return file.extension() == ".png" && stem.size() == 6 && stem.find_first_not_of("0123456789") == std::string::npos;
}

// Refuses a folder with other files than frames of an earlier path, so that nothing is mixed or lost.
void CheckFrameFolder(const fs::path& folder) {
  if (!fs::is_directory(folder)) return;
  for (const auto& entry : fs::directory_iterator(folder)) {
    if (IsFrame(entry.path())) continue;
    throw UsageError("-o is " + EscapePath(folder) + ", which holds " + EscapePath(entry.path().filename()) +
                     ": give a new folder, or one with frames of an earlier path");
  }
}

// The folder then holds these frames alone.
void CopyFrames(const fs::path& frames, const fs::path& folder) {
  fs::create_directories(folder);
  for (const fs::path& earlier : ListFiles(folder)) fs::remove(earlier);
  for (const fs::path& frame : ListFiles(frames)) {
    const fs::path source = frames / frame.filename();
    fs::copy_file(source, folder / frame.filename(), fs::copy_options::overwrite_existing);
  }
}

void Render(const RenderOptions& options) {
  const Workspace workspace{fs::path(options.workspace)};
  workspace.ReadMarker();
  const fs::path target = options.output_path;
  const bool to_mp4 = target.extension() == ".mp4" && !fs::is_directory(target);
  if (!to_mp4 && target.has_extension() && !fs::is_directory(target)) {
    throw UsageError("-o is " + EscapePath(target) + ": give a name that ends in .mp4, or a folder for PNG frames");
  }
  if (to_mp4) {
    if (target.has_parent_path()) fs::create_directories(target.parent_path());
  } else {
    CheckFrameFolder(target);
  }
  const WorkspaceLock lock(workspace);
  for (const char* stage : {"pose", "train"}) workspace.Require(stage);
  const fs::path out = workspace.root() / "paths" / PathName(options.path);
  fs::create_directories(out.parent_path());
  RenderFrames(options, workspace, out);
  if (to_mp4) {
    EncodeMp4(out / "rgb", options.fps, target, workspace.Log("ffmpeg"));
  } else {
    CopyFrames(out / "rgb", target);
  }
  std::cout << EscapePath(target) << '\n';
}

}  // namespace

Command AddRenderCommand(CLI::App& app) {
  auto options = std::make_shared<RenderOptions>();
  CLI::App* command = app.add_subcommand("render", "A camera path through the scene, as MP4 or PNG");
  const auto add = [&](const char* names, std::string& value, const char* type, const char* text) {
    return command->add_option(names, value, text)->type_name(type);
  };
  add("WORKSPACE", options->workspace, "", "Made by `nrff run`")->required();
  add("--path", options->path, "KIND", "orbit, spiral or a file of poses (default: orbit)")->check(CheckPath);
  add("-o,--output", options->output_path, "FILE", "out.mp4, or a folder for PNG frames")->required();
  add("--frames", options->frames, "N", "Of an orbit or spiral (default: 120)")->check(CheckPositive);
  add("--fps", options->fps, "N", "Frames a second (default: 30)")->check(CheckPositive);
  add("--width", options->width, "PX", "Of the frames (default: as the photos)")->check(CheckPositive);
  add("--height", options->height, "PX", "Of the frames (default: as the photos)")->check(CheckPositive);
  add("--device", options->device, "NAME", "auto, cpu or cuda")->check(CheckDevice);
  add("--threads", options->threads, "N", "Threads (default: all cores)")->check(CheckPositive);
  AddVerbosityOptions(*command, options->output);
  command->footer("Example: nrff render work/castle --path orbit -o orbit.mp4");
  return {command, [options] { Render(*options); }};
}

}  // namespace nrff
