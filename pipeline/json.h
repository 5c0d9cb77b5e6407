// JSON as this project reads and writes it.
#pragma once

#include <filesystem>
#include <nlohmann/json.hpp>
#include <string>

namespace nrff {

using Json = nlohmann::json;

// Throws CorruptError naming the file, the place and what was found.
Json ReadJson(const std::filesystem::path& path);

// Keys sorted, indented by one space, full double precision, atomically. Throws InputError on a non-finite number
// (JSON has none; nlohmann would write null).
void WriteJson(const std::filesystem::path& path, const Json& value);

// value[key] as T. Throws CorruptError naming `where`, the key, and whether it is missing or of another type.
template <typename T>
T Get(const Json& value, const char* key, const std::string& where);

// Checks {"schema_version": n}; a newer file is a CorruptError that says to update the program.
void CheckSchemaVersion(const Json& value, int supported, const std::string& where);

[[noreturn]] void ThrowMissingKey(const std::string& where, const char* key, const std::string& reason);

template <typename T>
T Get(const Json& value, const char* key, const std::string& where) {
  auto it = value.is_object() ? value.find(key) : value.end();
  if (it == value.end()) ThrowMissingKey(where, key, "is missing");
  try {
    return it->template get<T>();
  } catch (const nlohmann::json::exception&) {
    ThrowMissingKey(where, key, std::string("has the wrong type (") + it->type_name() + ")");
  }
}

}  // namespace nrff
