#include "pipeline/commands.h"

#include <cctype>
#include <cstdio>
#include <cstdlib>

#include "pipeline/error.h"

namespace nrff {
namespace {

bool IsWhole(const std::string& text) {
  constexpr size_t kMostDigits = 18;  // fits 64 bits
  if (text.empty() || text.size() > kMostDigits) return false;
  for (const char c : text) {
    if (std::isdigit(static_cast<unsigned char>(c)) == 0) return false;
  }
  return true;
}

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

}  // namespace

double ParseDuration(const std::string& text, const std::string& option) {
  double seconds = 0;
  const char* rest = text.c_str();
  while (*rest != '\0') {
    char* end = nullptr;
    const bool number = std::isdigit(static_cast<unsigned char>(*rest)) != 0;
    const double count = number ? std::strtod(rest, &end) : 0;
    const bool plain_seconds = number && *end == '\0' && rest == text.c_str();
    const double unit_seconds = !number ? 0 : plain_seconds ? 1 : SecondsOf(*end);
    seconds += count * unit_seconds;
    if (unit_seconds == 0) {
      seconds = 0;
      break;
    }
    rest = plain_seconds ? end : end + 1;
  }
  if (!(seconds >= 1 && seconds < 1e9)) {
    throw UsageError(option + " is '" + text + "': give a time of a second or more, as 90s, 10m, 1h or 1h30m");
  }
  return seconds;
}

void AddVerbosityOptions(CLI::App& command, OutputOptions& output) {
  auto* quiet = command.add_flag("-q,--quiet", output.quiet, "Warnings and errors only");
  command.add_flag("-v,--verbose", output.verbose, "All that the stages say")->excludes(quiet);
}

void AddJsonOption(CLI::App& command, OutputOptions& output) {
  command.add_flag("--json", output.json, "The result as JSON on standard output");
}

std::string CheckWhole(const std::string& text) { return IsWhole(text) ? "" : "'" + text + "' is no whole number"; }

std::string CheckPositive(const std::string& text) {
  if (IsWhole(text) && std::atoll(text.c_str()) > 0) return {};
  return "'" + text + "' is no whole number above zero";
}

std::string CheckDevice(const std::string& text) {
  if (text == "auto" || text == "cpu" || text == "cuda") return {};
  return "'" + text + "' is no device; give auto, cpu or cuda";
}

void PrintJson(const Json& json) {
  std::puts(json.dump(1, ' ', /*ensure_ascii=*/false, Json::error_handler_t::replace).c_str());
}

}  // namespace nrff
