// Safetensors files: named tensors with a JSON header, as every tensor library reads them. No torch.
//
//   8 bytes   header length N, little-endian
//   N bytes   JSON {"__metadata__": {text: text}, name: {"dtype", "shape", "data_offsets": [begin, end]}, …}
//   rest      tensor data, row-major little-endian, offsets relative to here, without gaps or overlaps
//
// Format: https://github.com/huggingface/safetensors (version 0.x). Element types: F32, F64, U8, I64.
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <map>
#include <string>
#include <type_traits>
#include <vector>

namespace nrff {

enum class DType { kF32, kF64, kU8, kI64 };

const char* DTypeName(DType dtype);  // "F32", …
size_t DTypeBytes(DType dtype);

template <typename T>
constexpr DType DTypeOf() {
  static_assert(std::is_same_v<T, float> || std::is_same_v<T, double> || std::is_same_v<T, uint8_t> ||
                std::is_same_v<T, int64_t>);
  if constexpr (std::is_same_v<T, float>) return DType::kF32;
  if constexpr (std::is_same_v<T, double>) return DType::kF64;
  if constexpr (std::is_same_v<T, int64_t>) return DType::kI64;
  return DType::kU8;
}

// A memory-mapped, fully checked file. Everything throws CorruptError naming the file and the place.
class SafetensorsFile {
 public:
  struct Tensor {
    DType dtype = DType::kF32;
    std::vector<int64_t> shape;
    const std::byte* data = nullptr;  // may be unaligned for its type: copy out
    size_t n_elements = 0;
    size_t n_bytes() const { return n_elements * DTypeBytes(dtype); }
  };

  // Throws InputError when the file cannot be opened, CorruptError when its header does not describe its bytes.
  explicit SafetensorsFile(const std::filesystem::path& path);
  ~SafetensorsFile();
  SafetensorsFile(const SafetensorsFile&) = delete;
  SafetensorsFile& operator=(const SafetensorsFile&) = delete;

  const std::filesystem::path& path() const { return path_; }
  const std::map<std::string, Tensor>& tensors() const { return tensors_; }
  const std::map<std::string, std::string>& metadata() const { return metadata_; }

  bool Has(const std::string& name) const { return tensors_.count(name) > 0; }
  // Throws when there is no such tensor.
  const Tensor& Get(const std::string& name) const;
  // Throws when the key is missing.
  const std::string& Metadata(const std::string& key) const;

  // Copies the elements. Throws when the type is another, or the shape (where given) is.
  template <typename T>
  std::vector<T> Values(const std::string& name) const {
    std::vector<T> values(Get(name).n_elements);
    CopyChecked(name, DTypeOf<T>(), nullptr, values.data());
    return values;
  }
  template <typename T>
  std::vector<T> Values(const std::string& name, const std::vector<int64_t>& shape) const {
    std::vector<T> values(Get(name).n_elements);
    CopyChecked(name, DTypeOf<T>(), &shape, values.data());
    return values;
  }

 private:
  void Parse();
  void CopyChecked(const std::string& name, DType dtype, const std::vector<int64_t>* shape, void* out) const;

  std::filesystem::path path_;
  const std::byte* bytes_ = nullptr;
  size_t size_ = 0;
  std::map<std::string, Tensor> tensors_;
  std::map<std::string, std::string> metadata_;
};

struct TensorToWrite {
  std::string name;
  DType dtype;
  std::vector<int64_t> shape;
  const void* data;  // [product of shape] elements; must outlive the call
};

// Writes atomically (WriteFileAtomically). Data starts at a multiple of 8 bytes, wide types first, so that a reader
// may map them in place. Throws std::invalid_argument on a repeated name.
void WriteSafetensors(const std::filesystem::path& path, std::vector<TensorToWrite> tensors,
                      const std::map<std::string, std::string>& metadata = {});

}  // namespace nrff
