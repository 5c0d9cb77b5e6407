// The header of an ONNX file.
#include <stdexcept>

#include "eval/onnx_reader.h"
#include "pipeline/json.h"
#include "tests/fuzz/fuzz.h"

namespace nrff::fuzz {
namespace {

// A field of protobuf's wire format.
std::string Number(int field, uint64_t value) {
  std::string bytes(1, static_cast<char>(field << 3));
  for (; value >= 0x80; value >>= 7) bytes += static_cast<char>(value | 0x80);
  return bytes + static_cast<char>(value);
}

std::string Bytes(int field, const std::string& content) {
  std::string bytes = Number(field, content.size());
  bytes[0] = static_cast<char>(bytes[0] | 2);
  return bytes + content;
}

}  // namespace

std::vector<std::string> Seeds() {
  const std::string floats(24, '\x3F');
  const std::string unpacked = Number(1, 2) + Number(1, 3) + Number(2, 1) + Bytes(8, "linear.0") + Bytes(9, floats);
  const std::string packed = Bytes(1, "\x02\x03") + Number(2, 1) + Bytes(8, "linear.1") + Bytes(9, floats);
  const std::string graph = Bytes(1, Bytes(1, "input") + Bytes(4, "Conv")) + Bytes(1, Bytes(4, "Relu")) +
                            Bytes(5, unpacked) + Bytes(5, packed) + Bytes(12, Bytes(1, "feature_0"));
  const std::string metadata = Bytes(14, Bytes(1, "nrff_lpips") + Bytes(2, "1"));
  return {Number(1, 8) + Bytes(2, "nrff") + Bytes(7, graph) + metadata};
}

}  // namespace nrff::fuzz

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace nrff;  // NOLINT(google-build-using-namespace)
  OnnxModel model;
  try {
    model = ReadOnnx({reinterpret_cast<const char*>(data), size});
  } catch (const std::runtime_error& error) {
    fuzz::RequireText(error.what(), "");  // the caller, who has the file's name, adds it
    return 0;
  }
  for (const OnnxTensor& tensor : model.constants) {
    uint64_t n_bytes = sizeof(float);
    for (const int64_t side : tensor.shape) n_bytes *= uint64_t(side);
    fuzz::Require(n_bytes == tensor.bytes.size(), "a constant has the size of its shape");
  }
  return 0;
}
