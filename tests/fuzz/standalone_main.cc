// Runs a fuzz target without libFuzzer: on the target's seeds and the files given, then, for some seconds, on simple
// mutations of them, always in the same order.
//
//   fuzz_NAME [--seconds S] [FILE or FOLDER …]
//
// An input that ends the process is left in fuzz_NAME.input.
#include <fcntl.h>
#include <sys/resource.h>
#include <unistd.h>

#include <array>
#include <chrono>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <random>
#include <string>
#include <string_view>
#include <vector>

#include "pipeline/files.h"
#include "tests/fuzz/fuzz.h"

#ifdef __SANITIZE_ADDRESS__
// Ends by a signal, so that the input is kept.
extern "C" const char* __asan_default_options() {  // NOLINT(bugprone-reserved-identifier)
  return "abort_on_error=1:max_allocation_size_mb=512";
}
extern "C" const char* __ubsan_default_options() {  // NOLINT(bugprone-reserved-identifier)
  return "abort_on_error=1:print_stacktrace=1";
}
#endif
extern "C" int LLVMFuzzerInitialize(int* argc, char*** argv);

namespace nrff::fuzz {
namespace {

constexpr unsigned kHang_seconds = 30;
constexpr rlim_t kMostMemory_bytes = rlim_t{2} << 30;
constexpr size_t kLongestInput = 1 << 16;

std::string_view current_input;  // of the run in progress
std::string kept_input_path;

// Only calls that are allowed in a signal handler.
void KeepInput(int signal) {
  constexpr std::string_view kSaid = "the input is in ";
  const int file = open(kept_input_path.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0666);
  [[maybe_unused]] ssize_t written = write(file, current_input.data(), current_input.size());
  written = write(STDERR_FILENO, kSaid.data(), kSaid.size());
  written = write(STDERR_FILENO, kept_input_path.data(), kept_input_path.size());
  written = write(STDERR_FILENO, "\n", 1);
  std::signal(signal, SIG_DFL);
  std::raise(signal);
}

// As the optimised build has no sanitizer to say so, memory taken on a file's word is an allocation that fails.
void LimitMemory() {
#ifndef __SANITIZE_ADDRESS__
  rlimit limit{};
  getrlimit(RLIMIT_AS, &limit);
  limit.rlim_cur = std::min(limit.rlim_max, kMostMemory_bytes);
  setrlimit(RLIMIT_AS, &limit);
#endif
}

void Run(const std::string& input) {
  const std::vector<uint8_t> bytes(input.begin(), input.end());  // of the very size, so that reading on is noticed
  current_input = input;
  alarm(kHang_seconds);
  LLVMFuzzerTestOneInput(bytes.data(), bytes.size());
  alarm(0);
}

class Mutator {
 public:
  explicit Mutator(std::vector<std::string> inputs) : inputs_(std::move(inputs)) {}

  std::string Next() {
    std::string input = inputs_[Below(inputs_.size())];
    for (size_t n = 1 + Below(4); n > 0; --n) Mutate(input);
    input.resize(std::min(input.size(), kLongestInput));
    return input;
  }

 private:
  size_t Below(size_t n) { return n < 2 ? 0 : random_() % n; }

  void Mutate(std::string& input) {
    static constexpr std::array<uint64_t, 10> kIntegers = {
        0, 1, 0x7F, 0xFF, 0x7FFF, 0x7FFFFFFF, 0x80000000, 0x7FFFFFFFFFFFFFFF, 0x8000000000000000, 0xFFFFFFFFFFFFFFFF};
    static constexpr std::array<std::string_view, 16> kWords = {
        "0",          "-1",   "1e308", "-1e308", "1e-320", "1e999",   "nan", "inf", "99999999999999999999",
        "2147483648", "null", "\"\"",  "[]",     "{}",     "\\u0000", "\xFF"};
    const size_t at = Below(input.size() + 1), length = 1 + Below(8);
    switch (Below(8)) {
      case 0:
        if (at < input.size()) input[at] = static_cast<char>(input[at] ^ (1 << Below(8)));
        break;
      case 1:
        if (at < input.size()) input[at] = static_cast<char>(Below(256));
        break;
      case 2:
        input.resize(at);
        break;
      case 3:
        input.erase(at, length);
        break;
      case 4:
        input.insert(at, std::string(input.substr(Below(input.size() + 1), 4 * length)));
        break;
      case 5: {
        const std::string& other = inputs_[Below(inputs_.size())];
        input.replace(at, std::string::npos, other.substr(Below(other.size() + 1)));
        break;
      }
      case 6: {
        const uint64_t value = kIntegers[Below(kIntegers.size())];
        input.replace(at, length, reinterpret_cast<const char*>(&value), length);
        break;
      }
      default: {  // a number of a text
        constexpr char kOfNumbers[] = "+-.0123456789e";
        const size_t begin = std::min(input.find_first_of(kOfNumbers, at), input.size());
        const size_t end = std::min(input.find_first_not_of(kOfNumbers, begin), input.size());
        input.replace(begin, end - begin, kWords[Below(kWords.size())]);
      }
    }
  }

  std::vector<std::string> inputs_;
  std::mt19937_64 random_{1};
};

int Main(int argc, char** argv) {
  LLVMFuzzerInitialize(&argc, &argv);
  double seconds = 0;
  std::vector<std::string> inputs = Seeds();
  for (int i = 1; i < argc; ++i) {
    if (std::string_view(argv[i]) == "--seconds" && i + 1 < argc) {
      seconds = std::strtod(argv[++i], nullptr);
      continue;
    }
    for (const std::filesystem::path& file : ListFiles(argv[i])) inputs.push_back(ReadFile(file));
  }
  kept_input_path = std::filesystem::absolute(std::filesystem::path(argv[0]).filename()).native() + ".input";
  LimitMemory();
  for (const int signal : {SIGABRT, SIGALRM, SIGBUS, SIGFPE, SIGILL, SIGSEGV}) std::signal(signal, KeepInput);
  for (const std::string& input : inputs) Run(input);
  const auto end = std::chrono::steady_clock::now() + std::chrono::duration<double>(seconds);
  size_t n_mutations = 0;
  for (Mutator mutator(inputs); std::chrono::steady_clock::now() < end; ++n_mutations) Run(mutator.Next());
  std::printf("%zu inputs and %zu mutations\n", inputs.size(), n_mutations);
  return 0;
}

}  // namespace
}  // namespace nrff::fuzz

int main(int argc, char** argv) { return nrff::fuzz::Main(argc, argv); }
