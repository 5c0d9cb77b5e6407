#include "pipeline/markdown.h"

#include <fmt/format.h>

namespace nrff {

std::string Figure(const Json& value, const char* format) {
  return value.is_number() ? fmt::format(fmt::runtime(format), value.get<double>()) : "–";
}

std::string BandText(const Json& band, const char* format) {
  if (!band.is_object()) return "–";
  const std::string mean = Figure(band.at("mean"), format), least = Figure(band.at("least"), format),
                    most = Figure(band.at("most"), format);
  return least == most ? mean : fmt::format("{} ({} to {})", mean, least, most);
}

std::string CellText(const Json& value) {
  std::string text = value.is_string() ? value.get<std::string>() : std::string();
  for (size_t at = text.find('|'); at != std::string::npos; at = text.find('|', at + 2)) text.replace(at, 1, "\\|");
  return text.empty() ? "–" : text;
}

}  // namespace nrff
