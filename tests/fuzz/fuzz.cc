#include "tests/fuzz/fuzz.h"

#include <cstdio>
#include <cstdlib>
#include <fstream>

#include "tests/temporary_directory.h"

extern "C" int LLVMFuzzerInitialize(int*, char***) {
  const char* folder = std::getenv("NRFF_WRITE_SEEDS");
  if (folder == nullptr) return 0;
  std::filesystem::create_directories(folder);
  int n = 0;
  for (const std::string& seed : nrff::fuzz::Seeds()) {
    std::ofstream(std::filesystem::path(folder) / ("seed-" + std::to_string(n++)), std::ios::binary) << seed;
  }
  std::exit(0);
}

namespace nrff::fuzz {

const std::filesystem::path& Folder() {
  static const TemporaryDirectory folder = [] {
    if (std::filesystem::is_directory("/dev/shm")) setenv("TMPDIR", "/dev/shm", /*overwrite=*/0);
    return TemporaryDirectory();
  }();
  return folder.path();
}

void Write(const std::filesystem::path& name, std::string_view bytes) {
  std::ofstream file(Folder() / name, std::ios::binary | std::ios::trunc);
  file.write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
  Require(file.flush().good(), "the input can be written to the folder in memory");
}

std::string Join(std::initializer_list<std::string_view> files) {
  std::string input;
  for (const std::string_view& file : files) {
    if (&file != files.begin()) input += kSeparator;
    input += file;
  }
  return input;
}

std::vector<std::string_view> Split(const uint8_t* data, size_t size, size_t n) {
  std::string_view rest(reinterpret_cast<const char*>(data), size);
  std::vector<std::string_view> files(n);
  for (size_t i = 0; i < n; ++i) {
    const size_t end = i + 1 < n ? rest.find(kSeparator) : std::string_view::npos;
    files[i] = rest.substr(0, end);
    if (end == std::string_view::npos) break;
    rest.remove_prefix(end + kSeparator.size());
  }
  return files;
}

void Require(bool holds, const char* law) {
  if (holds) return;
  std::fprintf(stderr, "does not hold: %s\n", law);
  std::abort();
}

void RequireText(const std::string& text, const std::string& file) {
  bool is_utf8 = true;
  try {
    static_cast<void>(Json(text).dump());
  } catch (const Json::exception&) {
    is_utf8 = false;
  }
  if (!is_utf8 || text.find(file) == std::string::npos) std::fprintf(stderr, "the error's text: %s\n", text.c_str());
  Require(is_utf8, "an error's text is UTF-8");
  Require(text.find(file) != std::string::npos, "an error's text names the file");
}

void RequireKept(const Json& read, const Json& written) {
  if (written.is_object()) {
    for (const auto& [key, value] : written.items()) RequireKept(read.at(key), value);
  } else if (written.is_array()) {
    for (size_t i = 0; i < written.size(); ++i) RequireKept(read.at(i), written[i]);
  } else {
    Require(read == written, "a value is read as it is in the file");
  }
}

}  // namespace nrff::fuzz
