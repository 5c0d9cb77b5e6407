// The stability table: what the tests in tests/stability measured on this machine, case by case, with the bound that
// follows from the number format.
//
//   stability.json  (schema 1)
//     cases  [{part, name, condition, error, bound}]: error null where it was no finite number
//     n_exceeded, host, version, date (UTC)
//   stability.md, stability.html  the same for people
#pragma once

#include <filesystem>
#include <string>

#include "pipeline/json.h"

namespace nrff {

// Runs the programs stability_* in `tests` and writes the three files into `folder`. Throws InputError where there are
// no such programs, ExternalToolError where one ends otherwise than tests do.
Json MeasureStability(const std::filesystem::path& tests, const std::filesystem::path& folder);

// What was measured into `folder`; null where nothing was. Throws CorruptError where its file is damaged.
Json ReadStability(const std::filesystem::path& folder);

// Of a workspace: what its report shows.
inline constexpr char kStabilityFolder[] = "stability";

std::string StabilityMarkdown(const Json& result);

}  // namespace nrff
