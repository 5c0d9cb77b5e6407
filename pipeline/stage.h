// What every stage executable's main shares: parsing, exit codes, the parameters that make the result.
#pragma once

#include <CLI/CLI.hpp>
#include <filesystem>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/manifest.h"

namespace nrff {

// CLI11 group of the options that change the result. Options in it enter the manifest's params; others (threads,
// verbosity, output place) do not.
inline constexpr char kParameterGroup[] = "Parameters";

// What options take, checked by the driver as by the stages.
inline constexpr int kMostThreads = 1024, kMostMaxImageSize = 65536;
inline constexpr int kLeastFramesAsked = 3, kMostFramesAsked = 2000;  // of each video
const std::vector<std::string>& MaskMeanings();
const std::vector<std::string>& CameraModelChoices();  // auto, and COLMAP's names

// The options of `app` in kParameterGroup that were given, as text (several values joined by ','; flags "true").
Params GivenParams(const CLI::App& app);

// Adds --quiet and --verbose.
void AddVerbosity(CLI::App& app);

// Adds an option for a decision that is made from facts unless it is forced: auto, or one of two words for needed and
// not needed.
void AddForcedOption(CLI::App& app, const std::string& name, std::optional<bool>& value, const std::string& needed,
                     const std::string& not_needed, const std::string& help);

// "90s", "10m", "1h", "1h30m", "600" (seconds) in seconds. Throws UsageError naming `option`.
double ParseDuration(const std::string& text, const std::string& option);

// Where the LPIPS network is looked for when none is given: nrff/lpips_vgg.onnx in $XDG_DATA_HOME or ~/.local/share.
// Empty when there is none.
std::filesystem::path DefaultLpipsNetwork();

// What stands for --lpips NETWORK in the manifest's params: name and content hash, so that scores made with another
// file of this name are stale. A file that cannot be read is its name alone: the stage will say what is wrong with it.
std::string LpipsParameter(const std::string& network);

// Parses, runs `body`, maps Error and std::exception to exit codes and one "error: …" line on stderr. Throws nothing.
// bad_alloc and ENOSPC end with kResource.
int StageMain(CLI::App& app, int argc, char** argv, const std::function<void()>& body);

}  // namespace nrff
