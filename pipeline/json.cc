#include "pipeline/json.h"

#include <cmath>
#include <set>
#include <vector>

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

// Goes through a text before values are made of it.
class Checker : public nlohmann::json_sax<Json> {
 public:
  explicit Checker(RepeatedKeys repeated_keys) : repeated_keys_(repeated_keys) {}

  bool null() override { return true; }
  bool boolean(bool) override { return true; }
  bool number_integer(number_integer_t) override { return true; }
  bool number_unsigned(number_unsigned_t) override { return true; }
  bool number_float(number_float_t, const string_t&) override { return true; }
  bool string(string_t&) override { return true; }
  bool binary(binary_t&) override { return true; }
  bool start_array(size_t) override { return Open(); }
  bool start_object(size_t) override { return Open(); }
  bool end_array() override { return Close(); }
  bool end_object() override { return Close(); }
  bool key(string_t& key) override {
    if (repeated_keys_ == RepeatedKeys::kRefuse && !keys_.back().insert(key).second) {
      throw JsonSyntaxError("it has the key '" + key + "' twice");
    }
    return true;
  }
  bool parse_error(size_t, const std::string&, const nlohmann::detail::exception& error) override {
    throw JsonSyntaxError(EscapePath(error.what()));  // quotes the text
  }

 private:
  bool Open() {
    keys_.emplace_back();
    if (keys_.size() > kMostJsonLevels) {
      throw JsonSyntaxError("it has more than " + std::to_string(kMostJsonLevels) +
                            " lists and objects within each other");
    }
    return true;
  }
  bool Close() {
    keys_.pop_back();
    return true;
  }

  RepeatedKeys repeated_keys_;
  std::vector<std::set<std::string>> keys_;  // of the lists and objects that are open
};

}  // namespace

Json ParseJson(std::string_view text, RepeatedKeys repeated_keys) {
  Checker checker(repeated_keys);
  Json::sax_parse(text, &checker);
  return Json::parse(text);
}

Json ReadJson(const std::filesystem::path& path) {
  try {
    return ParseJson(ReadFile(path));
  } catch (const JsonSyntaxError& error) {
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
