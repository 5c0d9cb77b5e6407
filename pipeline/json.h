// JSON as this project reads and writes it.
#pragma once

#include <filesystem>
#include <nlohmann/json.hpp>
#include <stdexcept>
#include <string>
#include <string_view>
#include <type_traits>
#include <utility>

namespace nrff {

using Json = nlohmann::json;

// A text that is not JSON: what() is a clause saying where and why, in UTF-8 whatever the text holds.
class JsonSyntaxError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

// Arrays and objects within each other: values are copied and printed by recursion, so that more could end the program.
inline constexpr int kMostJsonLevels = 100;

enum class RepeatedKeys { kLastCounts, kRefuse };

// Throws JsonSyntaxError, also where there are more levels than kMostJsonLevels.
Json ParseJson(std::string_view text, RepeatedKeys repeated_keys = RepeatedKeys::kLastCounts);

// Throws CorruptError naming the file, the place and what was found.
Json ReadJson(const std::filesystem::path& path);

// Keys sorted, indented by one space, full double precision, atomically. Throws InputError on a non-finite number
// (JSON has none; nlohmann would write null).
void WriteJson(const std::filesystem::path& path, const Json& value);

// value[key] as T. Throws CorruptError naming `where`, the key, and whether it is missing, of another type or, for
// whole numbers, beyond T's range.
template <typename T>
T Get(const Json& value, const char* key, const std::string& where);

// Checks {"schema_version": n}; a newer file is a CorruptError that says to update the program.
void CheckSchemaVersion(const Json& value, int supported, const std::string& where);

[[noreturn]] void ThrowMissingKey(const std::string& where, const char* key, const std::string& reason);

template <typename T>
T Get(const Json& value, const char* key, const std::string& where) {
  auto it = value.is_object() ? value.find(key) : value.end();
  if (it == value.end()) ThrowMissingKey(where, key, "is missing");
  if constexpr (std::is_integral_v<T> && !std::is_same_v<T, bool>) {  // get() would drop what does not fit
    const bool fits = it->is_number_unsigned()
                          ? std::in_range<T>(it->template get<uint64_t>())
                          : it->is_number_integer() && std::in_range<T>(it->template get<int64_t>());
    if (it->is_number() && !fits)
      ThrowMissingKey(where, key, "is " + it->dump() + ", which is no whole number or too large");
  }
  try {
    return it->template get<T>();
  } catch (const nlohmann::json::exception&) {
    ThrowMissingKey(where, key, std::string("has the wrong type (") + it->type_name() + ")");
  }
}

}  // namespace nrff
