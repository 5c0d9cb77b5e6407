// What the fuzz targets share.
//
// A target `fuzz_NAME.cc` feeds one parser with any bytes and requires that it reads them or throws an Error whose text
// names the file, and that what was read keeps the parser's promises. It defines LLVMFuzzerTestOneInput, for libFuzzer
// (preset `fuzz`) or for standalone_main.cc (every other build), and Seeds.
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <initializer_list>
#include <optional>
#include <string>
#include <string_view>
#include <type_traits>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/json.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);

namespace nrff::fuzz {

// Inputs that the target's parser can read, to start from. With NRFF_WRITE_SEEDS=FOLDER in its environment a target
// writes them there, one file each, and ends.
std::vector<std::string> Seeds();

// A folder in memory that lives as long as the process.
const std::filesystem::path& Folder();

// Writes Folder() / name.
void Write(const std::filesystem::path& name, std::string_view bytes);

// An input that stands for several files holds them one after the other with this line between them.
inline constexpr std::string_view kSeparator = "\n=====\n";
std::string Join(std::initializer_list<std::string_view> files);
// The first n - 1 files and the rest; those that are not there are empty.
std::vector<std::string_view> Split(const uint8_t* data, size_t size, size_t n);

// Ends the process with the law that does not hold.
void Require(bool holds, const char* law);
// Requires of an error's text that it names `file` and is UTF-8, as it goes into JSON files and on terminals.
void RequireText(const std::string& text, const std::string& file);

// Requires of what was read of the file `read` and written again that it is all in `read`: numbers have not changed.
void RequireKept(const Json& read, const Json& written);

// What `parse` returns; nothing where it throws an Error. `file`: what the error's text has to name.
template <typename Parse>
auto ParseOrError(const std::filesystem::path& file, Parse&& parse) -> std::optional<std::decay_t<decltype(parse())>> {
  try {
    return parse();
  } catch (const Error& error) {
    RequireText(error.what(), file.native());
    return std::nullopt;
  }
}

}  // namespace nrff::fuzz
