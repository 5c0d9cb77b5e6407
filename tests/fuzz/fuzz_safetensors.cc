// Safetensors files.
#include <cstring>

#include "model/safetensors.h"
#include "pipeline/files.h"
#include "tests/fuzz/fuzz.h"

namespace nrff::fuzz {
namespace {

constexpr char kFile[] = "model.safetensors";

void RequireSame(const SafetensorsFile& a, const SafetensorsFile& b) {
  Require(a.metadata() == b.metadata(), "metadata that is written is read as it was");
  Require(a.tensors().size() == b.tensors().size(), "as many tensors are read as were written");
  for (const auto& [name, tensor] : a.tensors()) {
    const SafetensorsFile::Tensor& other = b.Get(name);
    const bool same = tensor.dtype == other.dtype && tensor.shape == other.shape &&
                      tensor.n_bytes() == other.n_bytes() &&
                      (tensor.n_bytes() == 0 || std::memcmp(tensor.data, other.data, tensor.n_bytes()) == 0);
    Require(same, "a tensor that is written is read as it was");
  }
}

}  // namespace

std::vector<std::string> Seeds() {
  const std::vector<float> grid = {0, 1, -2.5F, 3, 4, 5};
  const std::vector<double> box = {-1, 1};
  const std::vector<int64_t> steps = {7};
  const std::vector<uint8_t> bits = {1, 2, 255};
  WriteSafetensors(Folder() / kFile,
                   {{"grid/plane", DType::kF32, {2, 3}, grid.data()},
                    {"box", DType::kF64, {2}, box.data()},
                    {"steps", DType::kI64, {}, steps.data()},
                    {"bits", DType::kU8, {3, 1}, bits.data()},
                    {"none", DType::kF32, {0, 4}, nullptr}},
                   {{"config", R"({"levels":4})"}, {"format", "nrff"}});
  return {ReadFile(Folder() / kFile)};
}

}  // namespace nrff::fuzz

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace nrff;  // NOLINT(google-build-using-namespace)
  const std::filesystem::path path = fuzz::Folder() / fuzz::kFile, copy = fuzz::Folder() / "copy.safetensors";
  fuzz::Write(fuzz::kFile, {reinterpret_cast<const char*>(data), size});
  const auto file = fuzz::ParseOrError(path, [&] { return std::make_shared<SafetensorsFile>(path); });
  if (!file) return 0;
  std::vector<TensorToWrite> tensors;
  for (const auto& entry : (*file)->tensors()) {
    fuzz::ParseOrError(path, [&] { return (*file)->Values<float>(entry.first); });
    tensors.push_back({entry.first, entry.second.dtype, entry.second.shape, entry.second.data});
  }
  WriteSafetensors(copy, tensors, (*file)->metadata());
  fuzz::RequireSame(**file, SafetensorsFile(copy));
  return 0;
}
