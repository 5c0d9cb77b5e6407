#include "model/cuda/gpu_library.h"

#include <dlfcn.h>

#include <exception>
#include <filesystem>

#include "pipeline/error.h"
#include "pipeline/manifest.h"

namespace nrff {
namespace {

// Kernels and host logic are held against the CPU's in an emulation; tests/bench/gpu.sh has not been run on a GPU yet.
// Until it has, only who asks for the GPU gets it.
constexpr bool kProvenOnHardware = false;

bool SeesGpu() {
  std::error_code absent;
  return std::filesystem::exists("/dev/nvidia0", absent) || std::filesystem::exists("/dev/dxg", absent);
}

// Beside the program, or where a build or an installation puts libraries.
std::filesystem::path FindLibrary() {
  std::error_code absent;
  const std::filesystem::path bin = std::filesystem::read_symlink("/proc/self/exe", absent).parent_path();
  for (const std::filesystem::path& dir : {bin, bin.parent_path(), bin.parent_path() / "lib"}) {
    if (std::filesystem::exists(dir / kGpuLibraryFile, absent)) return dir / kGpuLibraryFile;
  }
  return {};
}

struct Opened {
  const GpuLibrary* library = nullptr;
  std::string what;  // the GPU, or why there is none
};

Opened Open() {
  if (!SeesGpu()) return {nullptr, "no GPU"};
  const std::filesystem::path path = FindLibrary();
  if (path.empty())
    return {nullptr, std::string("a GPU, but no ") + kGpuLibraryFile + " (build with the CUDA toolkit)"};
  void* handle = dlopen(path.c_str(), RTLD_NOW | RTLD_LOCAL);
  if (handle == nullptr) return {nullptr, std::string("a GPU, but ") + dlerror()};
  using Function = const GpuLibrary* (*)();
  const auto function = reinterpret_cast<Function>(dlsym(handle, kGpuLibrarySymbol));
  if (function == nullptr) return {nullptr, std::string(kGpuLibraryFile) + " is not of nrff"};
  const GpuLibrary* library = function();
  if (library->version != Version()) {
    return {nullptr, std::string(kGpuLibraryFile) + " is of nrff " + library->version + ", this is " + Version()};
  }
  try {
    return {library, library->describe_gpu()};
  } catch (const std::exception& error) {
    return {nullptr, error.what()};
  }
}

}  // namespace

Device ChooseDevice(const std::string& asked) {
  if (asked == "cpu") return {needs::Cuda(false, "--device cpu"), {}};
  static const Opened opened = Open();
  if (opened.library == nullptr) {
    if (asked == "cuda") {
      throw ResourceError("--device cuda was asked for and cannot be had: " + opened.what +
                          "; use --device auto or cpu");
    }
    return {needs::Cuda(false, opened.what), {}};
  }
  if (asked == "auto" && !kProvenOnHardware) {
    return {needs::Cuda(false, opened.what + ", which no test has run on yet: --device cuda takes it"), {}};
  }
  return {needs::Cuda(true, opened.what), opened.library->make_trainer};
}

}  // namespace nrff
