#include "pipeline/markdown.h"

#include <fmt/format.h>

namespace nrff {

std::string Figure(const Json& value, const char* format) {
  return value.is_number() ? fmt::format(fmt::runtime(format), value.get<double>()) : "–";
}

std::string CellText(const Json& value) {
  std::string text = value.is_string() ? value.get<std::string>() : std::string();
  for (size_t at = text.find('|'); at != std::string::npos; at = text.find('|', at + 2)) text.replace(at, 1, "\\|");
  return text.empty() ? "–" : text;
}

}  // namespace nrff
