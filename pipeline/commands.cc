#include "pipeline/commands.h"

#include <cctype>
#include <cstdio>
#include <cstdlib>

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

}  // namespace

void AddVerbosityOptions(CLI::App& command, OutputOptions& output) {
  auto* quiet = command.add_flag("-q,--quiet", output.quiet, "Warnings and errors only");
  auto* verbose = command.add_flag("-v,--verbose", output.verbose, "All that the stages say")->excludes(quiet);
  for (CLI::Option* option : {quiet, verbose}) option->option_text(" ");  // one line each: that they exclude is plain
}

void AddJsonOption(CLI::App& command, OutputOptions& output) {
  command.add_flag("--json", output.json, "The result as JSON on standard output");
}

std::string CheckWhole(const std::string& text) { return IsWhole(text) ? "" : "'" + text + "' is no whole number"; }

std::string CheckPositive(const std::string& text) {
  if (IsWhole(text) && std::atoll(text.c_str()) > 0) return {};
  return "'" + text + "' is no whole number above zero";
}

std::string CheckRange(const std::string& text, int least, int most) {
  if (IsWhole(text) && std::atoll(text.c_str()) >= least && std::atoll(text.c_str()) <= most) return {};
  return "'" + text + "' is no whole number from " + std::to_string(least) + " to " + std::to_string(most);
}

std::string CheckDevice(const std::string& text) {
  if (text == "auto" || text == "cpu" || text == "cuda") return {};
  return "'" + text + "' is no device; give auto, cpu or cuda";
}

void PrintJson(const Json& json) {
  std::puts(json.dump(1, ' ', /*ensure_ascii=*/false, Json::error_handler_t::replace).c_str());
}

}  // namespace nrff
