#include "pipeline/json.h"

#include <cmath>

#include "pipeline/error.h"
#include "pipeline/files.h"

namespace nrff {
namespace {

void CheckFinite(const Json& value, const std::string& place, const std::filesystem::path& path) {
  if (value.is_number_float() && !std::isfinite(value.get<double>())) {
    throw InputError("cannot write " + EscapePath(path) + ": the number at " + place + " is not finite");
  }
  if (!value.is_structured()) return;
  for (const auto& [key, child] : value.items()) CheckFinite(child, place + "/" + key, path);
}

}  // namespace

Json ReadJson(const std::filesystem::path& path) {
  const std::string text = ReadFile(path);
  try {
    return Json::parse(text);
  } catch (const nlohmann::json::exception& error) {
    throw CorruptError(EscapePath(path) + " is not valid JSON: " + error.what());
  }
}

void WriteJson(const std::filesystem::path& path, const Json& value) {
  CheckFinite(value, "", path);
  WriteFileAtomically(path, value.dump(1) + "\n");
}

void ThrowMissingKey(const std::string& where, const char* key, const std::string& reason) {
  throw CorruptError(where + ": \"" + key + "\" " + reason);
}

void CheckSchemaVersion(const Json& value, int supported, const std::string& where) {
  const int version = Get<int>(value, "schema_version", where);
  if (version > supported) {
    throw CorruptError(where + " has schema version " + std::to_string(version) + ", this program reads up to " +
                       std::to_string(supported) + ": update nrff");
  }
  if (version < 1)
    throw CorruptError(where + " has schema version " + std::to_string(version) + ", expected 1 or more");
}

}  // namespace nrff
