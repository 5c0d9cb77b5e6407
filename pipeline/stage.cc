#include "pipeline/stage.h"

#include <cerrno>
#include <charconv>
#include <cstdio>
#include <new>
#include <system_error>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/log.h"
#include "pipeline/needs.h"

namespace nrff {
namespace {

double SecondsOf(char unit) {
  switch (unit) {
    case 's':
      return 1;
    case 'm':
      return 60;
    case 'h':
      return 3600;
    default:
      return 0;
  }
}

// 0 where the text is no duration.
double SecondsIn(const std::string& text) {
  double seconds = 0;
  const char* const end = text.data() + text.size();
  for (const char* rest = text.data(); rest != end;) {
    double count = 0;
    const auto [after, error] = std::from_chars(rest, end, count, std::chars_format::fixed);
    if (error != std::errc() || !(count >= 0 && count < 1e9)) return 0;
    if (after == end) return rest == text.data() ? count : 0;
    const double unit_seconds = SecondsOf(*after);
    if (unit_seconds == 0) return 0;
    seconds += count * unit_seconds;
    rest = after + 1;
  }
  return seconds;
}

// The program, and the sub-command that was being read.
std::string CommandName(const CLI::App& app) {
  std::string name = app.get_name();
  for (auto parsed = app.get_subcommands(); !parsed.empty(); parsed = parsed.front()->get_subcommands()) {
    name += " " + parsed.front()->get_name();
  }
  return name;
}

}  // namespace

const std::vector<std::string>& MaskMeanings() {
  static const std::vector<std::string> meanings = {"ignore", "background", "off"};
  return meanings;
}

const std::vector<std::string>& CameraModelChoices() {
  static const std::vector<std::string> choices = {"auto",
                                                   "SIMPLE_PINHOLE",
                                                   "PINHOLE",
                                                   "SIMPLE_RADIAL",
                                                   "RADIAL",
                                                   "OPENCV",
                                                   "FULL_OPENCV",
                                                   "OPENCV_FISHEYE",
                                                   "SIMPLE_RADIAL_FISHEYE",
                                                   "RADIAL_FISHEYE",
                                                   "THIN_PRISM_FISHEYE"};
  return choices;
}

Params GivenParams(const CLI::App& app) {
  Params params;
  for (const CLI::Option* option : app.get_options()) {
    if (option->get_group() != kParameterGroup || option->count() == 0) continue;
    std::string value;
    for (const std::string& part : option->results()) value += (value.empty() ? "" : ",") + part;
    params[option->get_single_name()] = value;
  }
  return params;
}

std::filesystem::path DefaultLpipsNetwork() {
  const char *data = std::getenv("XDG_DATA_HOME"), *home = std::getenv("HOME");
  std::filesystem::path folder;
  if (data != nullptr && *data != '\0') {
    folder = data;
  } else if (home != nullptr && *home != '\0') {
    folder = std::filesystem::path(home) / ".local" / "share";
  } else {
    return {};
  }
  const std::filesystem::path file = folder / "nrff" / "lpips_vgg.onnx";
  std::error_code absent;
  return std::filesystem::is_regular_file(file, absent) ? file : std::filesystem::path();
}

std::string LpipsParameter(const std::string& network) {
  if (network == needs::kNoLpips) return network;
  try {
    return network + " (" + HashFile(network) + ")";
  } catch (const Error&) {
    return network;
  }
}

void AddVerbosity(CLI::App& app) {
  auto* quiet = app.add_flag_callback(
      "-q,--quiet", [] { SetVerbosity(Verbosity::kQuiet); }, "Warnings and errors only");
  app.add_flag_callback(
         "-v,--verbose", [] { SetVerbosity(Verbosity::kVerbose); }, "More detail")
      ->excludes(quiet);
}

void AddForcedOption(CLI::App& app, const std::string& name, std::optional<bool>& value, const std::string& needed,
                     const std::string& not_needed, const std::string& help) {
  app.add_option_function<std::string>(
         name,
         [&value, needed](const std::string& text) {
           value = text == "auto" ? std::nullopt : std::optional(text == needed);
         },
         help)
      ->check(CLI::IsMember(std::vector<std::string>{"auto", needed, not_needed}))
      ->default_str("auto")
      ->group(kParameterGroup);
}

double ParseDuration(const std::string& text, const std::string& option) {
  const double seconds = SecondsIn(text);
  if (!(seconds >= 1 && seconds < 1e9)) {
    throw UsageError(option + " is '" + text +
                     "': give a time of a second or more, as 90s, 10m, 1h or 1h30m; a number alone is seconds");
  }
  return seconds;
}

int StageMain(CLI::App& app, int argc, char** argv, const std::function<void()>& body) {
  const auto fail = [](ExitCode code, const std::string& message) {
    std::fprintf(stderr, "error: %s\n", message.c_str());
    return static_cast<int>(code);
  };
  try {
    app.parse(argc, argv);
  } catch (const CLI::Success& success) {  // --help, --version
    return app.exit(success);
  } catch (const CLI::Error& error) {
    return fail(ExitCode::kUsage, std::string(error.what()) + " (see " + CommandName(app) + " --help)");
  }
  try {
    body();
    return static_cast<int>(ExitCode::kDone);
  } catch (const Error& error) {
    return fail(error.code(), error.what());
  } catch (const std::bad_alloc&) {
    return fail(ExitCode::kResource, app.get_name() + " ran out of memory: use --max-image-size or a smaller --preset");
  } catch (const std::system_error& error) {  // std::filesystem's, too
    const bool resource =
        error.code() == std::errc::no_space_on_device || error.code() == std::errc::read_only_file_system ||
        error.code() == std::errc::permission_denied || error.code() == std::errc::too_many_files_open;
    return fail(resource ? ExitCode::kResource : ExitCode::kInput, error.what());
  } catch (const std::exception& error) {
    return fail(ExitCode::kResource, app.get_name() + " failed unexpectedly: " + error.what());
  }
}

}  // namespace nrff
