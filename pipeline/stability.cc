#include "pipeline/stability.h"

#include <fmt/chrono.h>
#include <fmt/format.h>

#include <algorithm>
#include <ctime>
#include <sstream>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/manifest.h"
#include "pipeline/markdown.h"
#include "pipeline/process.h"
#include "pipeline/report_page.h"
#include "pipeline/report_summary.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr int kStabilitySchemaVersion = 1;
constexpr char kPrograms[] = "stability_", kFile[] = "stability.json";

std::vector<fs::path> Programs(const fs::path& tests) {
  std::vector<fs::path> programs;
  std::error_code error;
  for (const fs::directory_entry& entry : fs::directory_iterator(tests, error)) {
    const bool named = entry.path().filename().string().starts_with(kPrograms);
    if (named && entry.path().extension().empty() && entry.is_regular_file(error)) programs.push_back(entry.path());
  }
  if (programs.empty()) {
    throw InputError("No stability tests in " + EscapePath(tests) + "; build them with tools/build.sh.");
  }
  std::sort(programs.begin(), programs.end());
  return programs;
}

bool Exceeded(const Json& row) {
  const Json& error = row.at("error");
  return !error.is_number() || error.get<double>() > row.at("bound").get<double>();
}

Json ReadCases(const fs::path& table) {
  Json cases = Json::array();
  if (!fs::exists(table)) return cases;
  std::istringstream lines(ReadFile(table));
  for (std::string line; std::getline(lines, line);) cases.push_back(Json::parse(line));
  return cases;
}

// bound / error: how often the error would fit.
std::string Margin(const Json& row) {
  if (Exceeded(row)) return "EXCEEDED";
  const double error = row.at("error").get<double>();
  if (error == 0) return row.at("bound") == 0 ? "exact" : "∞";
  return fmt::format("{:.3g}", row.at("bound").get<double>() / error);
}

}  // namespace

Json MeasureStability(const fs::path& tests, const fs::path& folder) {
  const std::vector<fs::path> programs = Programs(tests);
  fs::create_directories(folder);
  const fs::path table = folder / "cases.jsonl";
  fs::remove(table);
  int64_t n_exceeded_before = 0;
  for (const fs::path& program : programs) {
    const std::string name = program.filename().string();
    ProcessOptions options;
    options.command = {program.string(), "--gtest_brief=1"};
    options.environment = {{"NRFF_STABILITY_TABLE", fs::absolute(table).string()}};
    options.log = folder / (name + ".log");
    const ProcessResult result = RunProcess(options);
    const Json measured = ReadCases(table);
    const auto n_exceeded = std::count_if(measured.begin(), measured.end(), Exceeded);
    // 1: a test failed, which is all right where the table says why.
    const bool told = result.exit_code == 1 && n_exceeded > n_exceeded_before;
    n_exceeded_before = n_exceeded;
    if (result.end != ProcessResult::End::kExited || (result.exit_code != 0 && !told)) {
      throw ExternalToolError(name + " " + DescribeEnd(result) + "; see " + EscapePath(options.log));
    }
  }
  const Json cases = ReadCases(table);
  fs::remove(table);
  Json result = {{"schema_version", kStabilitySchemaVersion},
                 {"cases", cases},
                 {"n_exceeded", std::count_if(cases.begin(), cases.end(), Exceeded)},
                 {"host", ThisHost()},
                 {"version", Version()},
                 {"date", fmt::format("{:%Y-%m-%d}", fmt::gmtime(std::time(nullptr)))}};
  WriteJson(folder / kFile, result);
  WriteFileAtomically(folder / "stability.md", StabilityMarkdown(result));
  WriteFileAtomically(folder / "stability.html", FillPage("stability.html", "Numerical stability", result));
  return result;
}

Json ReadStability(const fs::path& folder) {
  const fs::path file = folder / kFile;
  if (!fs::exists(file)) return nullptr;
  Json result = ReadJson(file);
  const bool whole = result.is_object() && result.value("schema_version", 0) == kStabilitySchemaVersion &&
                     result.contains("cases") && result.at("cases").is_array() && result.contains("n_exceeded");
  if (!whole) {
    throw CorruptError(EscapePath(file) +
                       " is not what `nrff benchmark stability` of this version writes; run it again.");
  }
  return result;
}

std::string StabilityMarkdown(const Json& result) {
  const Json& cases = result.at("cases");
  std::string text = fmt::format(
      "# Numerical stability\n\nnrff {}, {}, {}. Command: `nrff benchmark stability`. {} cases, {} beyond their "
      "bounds. "
      "The error is the largest one met, or that with the least margin where bounds differ; the bound follows from the "
      "number format (tests/stability says how), the margin is their ratio.\n\n"
      "| part | case | condition | error | bound | margin |\n|---|---|---|---:|---:|---:|\n",
      CellText(result.at("version")), CellText(At(result.at("host"), "cpu")), CellText(result.at("date")), cases.size(),
      result.at("n_exceeded").get<int>());
  for (const Json& row : cases) {
    text += fmt::format("| {} | {} | {} | {} | {} | {} |\n", CellText(row.at("part")), CellText(row.at("name")),
                        CellText(row.at("condition")), Figure(row.at("error"), "{:.2e}"),
                        Figure(row.at("bound"), "{:.2e}"), Margin(row));
  }
  return text;
}

}  // namespace nrff
