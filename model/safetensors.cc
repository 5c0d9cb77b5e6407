#include "model/safetensors.h"

#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <bit>
#include <cerrno>
#include <cstring>
#include <limits>
#include <stdexcept>
#include <string_view>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"

namespace nrff {
namespace {

static_assert(std::endian::native == std::endian::little, "tensor data is read and written in place");

constexpr size_t kLengthBytes = 8;
constexpr uint64_t kMaxHeaderBytes = 100'000'000;  // the format's own limit
constexpr char kMetadataKey[] = "__metadata__";

struct DTypeEntry {
  DType dtype;
  const char* name;
  size_t bytes;
};
constexpr DTypeEntry kDTypes[] = {
    {DType::kF32, "F32", 4}, {DType::kF64, "F64", 8}, {DType::kU8, "U8", 1}, {DType::kI64, "I64", 8}};

const DTypeEntry& EntryOf(DType dtype) {
  return *std::find_if(std::begin(kDTypes), std::end(kDTypes), [&](const auto& e) { return e.dtype == dtype; });
}

[[noreturn]] void ThrowCorrupt(const std::filesystem::path& path, const std::string& what) {
  throw CorruptError(EscapePath(path) + ": " + what + "; the file is damaged or not a safetensors file");
}

std::string ShapeText(const std::vector<int64_t>& shape) {
  std::string text = "[";
  for (size_t i = 0; i < shape.size(); ++i) text += (i ? ", " : "") + std::to_string(shape[i]);
  return text + "]";
}

// Repeated keys, which a JSON object would silently swallow, are refused.
Json ParseHeader(const std::filesystem::path& path, std::string_view text) {
  Json header;
  try {
    header = ParseJson(text, RepeatedKeys::kRefuse);
  } catch (const JsonSyntaxError& error) {
    ThrowCorrupt(path, std::string("the header is not valid JSON (") + error.what() + ")");
  }
  if (!header.is_object()) ThrowCorrupt(path, "the header is not a JSON object");
  return header;
}

// A list of non-negative integers below 2^63.
std::vector<int64_t> ParseSizes(const std::filesystem::path& path, const std::string& name, const Json& entry,
                                const char* key) {
  const auto it = entry.find(key);
  if (it == entry.end() || !it->is_array()) ThrowCorrupt(path, "tensor '" + name + "' has no list '" + key + "'");
  std::vector<int64_t> sizes;
  for (const Json& value : *it) {
    if (!value.is_number_unsigned() || value.get<uint64_t>() > uint64_t(std::numeric_limits<int64_t>::max())) {
      ThrowCorrupt(path, "tensor '" + name + "': '" + key + "' holds " + value.dump() + ", not a size");
    }
    sizes.push_back(value.get<int64_t>());
  }
  return sizes;
}

}  // namespace

const char* DTypeName(DType dtype) { return EntryOf(dtype).name; }
size_t DTypeBytes(DType dtype) { return EntryOf(dtype).bytes; }

SafetensorsFile::SafetensorsFile(const std::filesystem::path& path) : path_(path) {
  const int fd = ::open(path.c_str(), O_RDONLY | O_CLOEXEC);
  struct stat status {};
  if (fd < 0 || ::fstat(fd, &status) != 0) {
    const std::string reason = std::strerror(errno);
    if (fd >= 0) ::close(fd);
    throw InputError(EscapePath(path) + " cannot be opened (" + reason + "): expected a safetensors file");
  }
  size_ = size_t(status.st_size);
  if (size_ > 0) {
    void* mapped = ::mmap(nullptr, size_, PROT_READ, MAP_PRIVATE, fd, 0);
    if (mapped != MAP_FAILED) bytes_ = static_cast<const std::byte*>(mapped);
  }
  const std::string reason = std::strerror(errno);
  ::close(fd);
  if (size_ > 0 && !bytes_) throw InputError(EscapePath(path) + " cannot be mapped (" + reason + ")");
  try {
    Parse();
  } catch (...) {
    if (bytes_) ::munmap(const_cast<std::byte*>(bytes_), size_);
    throw;
  }
}

SafetensorsFile::~SafetensorsFile() {
  if (bytes_) ::munmap(const_cast<std::byte*>(bytes_), size_);
}

void SafetensorsFile::Parse() {
  if (size_ < kLengthBytes)
    ThrowCorrupt(path_, "it has " + std::to_string(size_) + " bytes, fewer than the 8 of a length");
  uint64_t header_bytes = 0;
  std::memcpy(&header_bytes, bytes_, kLengthBytes);
  if (header_bytes > kMaxHeaderBytes || header_bytes > size_ - kLengthBytes) {
    ThrowCorrupt(path_, "its header should have " + std::to_string(header_bytes) + " bytes, but the file has " +
                            std::to_string(size_));
  }
  const char* text = reinterpret_cast<const char*>(bytes_ + kLengthBytes);
  const Json header = ParseHeader(path_, {text, header_bytes});
  const std::byte* data = bytes_ + kLengthBytes + header_bytes;
  const int64_t data_bytes = int64_t(size_ - kLengthBytes - header_bytes);

  struct Range {
    int64_t begin, end;
    const std::string* name;
  };
  std::vector<Range> ranges;
  for (const auto& [name, entry] : header.items()) {
    if (!entry.is_object()) ThrowCorrupt(path_, "the header's entry '" + name + "' is not an object");
    if (name == kMetadataKey) {
      for (const auto& [key, value] : entry.items()) {
        if (!value.is_string()) ThrowCorrupt(path_, "metadata '" + key + "' is not text");
        metadata_[key] = value.get<std::string>();
      }
      continue;
    }
    const Json dtype_name = entry.value("dtype", Json());
    const auto* dtype = std::find_if(std::begin(kDTypes), std::end(kDTypes),
                                     [&](const DTypeEntry& candidate) { return dtype_name == candidate.name; });
    if (dtype == std::end(kDTypes)) {
      ThrowCorrupt(path_, "tensor '" + name + "' has the type " + dtype_name.dump() + ", expected F32, F64, U8 or I64");
    }
    Tensor tensor;
    tensor.dtype = dtype->dtype;
    tensor.shape = ParseSizes(path_, name, entry, "shape");
    const std::vector<int64_t> offsets = ParseSizes(path_, name, entry, "data_offsets");
    if (offsets.size() != 2 || offsets[0] > offsets[1] || offsets[1] > data_bytes) {
      ThrowCorrupt(path_, "tensor '" + name + "' should lie at bytes " + ShapeText(offsets) + " of " +
                              std::to_string(data_bytes));
    }
    int64_t n_bytes = int64_t(dtype->bytes);
    for (const int64_t size : tensor.shape) {
      if (__builtin_mul_overflow(n_bytes, size, &n_bytes)) {
        ThrowCorrupt(path_, "tensor '" + name + "' has the impossible shape " + ShapeText(tensor.shape));
      }
    }
    if (n_bytes != offsets[1] - offsets[0]) {
      ThrowCorrupt(path_, "tensor '" + name + "' of shape " + ShapeText(tensor.shape) + " needs " +
                              std::to_string(n_bytes) + " bytes but has " + std::to_string(offsets[1] - offsets[0]));
    }
    tensor.n_elements = size_t(n_bytes) / dtype->bytes;
    tensor.data = data + offsets[0];
    const auto [it, inserted] = tensors_.emplace(name, std::move(tensor));
    ranges.push_back({offsets[0], offsets[1], &it->first});
  }

  std::sort(ranges.begin(), ranges.end(),
            [](const Range& a, const Range& b) { return std::pair(a.begin, a.end) < std::pair(b.begin, b.end); });
  int64_t expected = 0;
  for (const Range& range : ranges) {
    if (range.begin != expected) {
      ThrowCorrupt(path_, "tensor '" + *range.name + "' starts at byte " + std::to_string(range.begin) +
                              ", but the one before it ends at " + std::to_string(expected));
    }
    expected = range.end;
  }
  if (expected != data_bytes) {
    ThrowCorrupt(path_, "its tensors end at byte " + std::to_string(expected) + " of " + std::to_string(data_bytes));
  }
}

const SafetensorsFile::Tensor& SafetensorsFile::Get(const std::string& name) const {
  const auto it = tensors_.find(name);
  if (it == tensors_.end()) throw CorruptError(EscapePath(path_) + " has no tensor '" + name + "'");
  return it->second;
}

const std::string& SafetensorsFile::Metadata(const std::string& key) const {
  const auto it = metadata_.find(key);
  if (it == metadata_.end()) throw CorruptError(EscapePath(path_) + " has no metadata '" + key + "'");
  return it->second;
}

void SafetensorsFile::CopyChecked(const std::string& name, DType dtype, const std::vector<int64_t>* shape,
                                  void* out) const {
  const Tensor& tensor = Get(name);
  if (tensor.dtype != dtype) {
    throw CorruptError(EscapePath(path_) + ": tensor '" + name + "' has the type " + DTypeName(tensor.dtype) +
                       ", expected " + DTypeName(dtype));
  }
  if (shape && tensor.shape != *shape) {
    throw CorruptError(EscapePath(path_) + ": tensor '" + name + "' has the shape " + ShapeText(tensor.shape) +
                       ", expected " + ShapeText(*shape));
  }
  if (tensor.n_elements > 0) std::memcpy(out, tensor.data, tensor.n_bytes());
}

void WriteSafetensors(const std::filesystem::path& path, std::vector<TensorToWrite> tensors,
                      const std::map<std::string, std::string>& metadata) {
  std::stable_sort(tensors.begin(), tensors.end(), [](const TensorToWrite& a, const TensorToWrite& b) {
    return DTypeBytes(a.dtype) > DTypeBytes(b.dtype);
  });
  Json header = Json::object();
  if (!metadata.empty()) header[kMetadataKey] = metadata;
  std::vector<size_t> n_bytes;
  size_t end = 0;
  for (const TensorToWrite& tensor : tensors) {
    if (header.contains(tensor.name)) throw std::invalid_argument("repeated tensor name " + tensor.name);
    size_t bytes = DTypeBytes(tensor.dtype);
    for (const int64_t size : tensor.shape) bytes *= size_t(size);
    header[tensor.name] = {
        {"dtype", DTypeName(tensor.dtype)}, {"shape", tensor.shape}, {"data_offsets", {end, end + bytes}}};
    n_bytes.push_back(bytes);
    end += bytes;
  }
  std::string text = header.dump();
  text.resize((text.size() + 7) / 8 * 8, ' ');  // the data starts aligned

  std::string bytes(kLengthBytes + text.size() + end, '\0');
  const uint64_t header_bytes = text.size();
  std::memcpy(bytes.data(), &header_bytes, kLengthBytes);
  std::memcpy(bytes.data() + kLengthBytes, text.data(), text.size());
  char* out = bytes.data() + kLengthBytes + text.size();
  for (size_t i = 0; i < tensors.size(); ++i) {
    if (n_bytes[i] > 0) std::memcpy(out, tensors[i].data, n_bytes[i]);
    out += n_bytes[i];
  }
  WriteFileAtomically(path, bytes);
}

}  // namespace nrff
