#include "eval/onnx_reader.h"

#include <optional>
#include <stdexcept>

#include "pipeline/files.h"

namespace nrff {
namespace {

// Of onnx.proto.
constexpr uint64_t kModelGraph = 7, kModelMetadata = 14, kEntryKey = 1, kEntryValue = 2;
constexpr uint64_t kGraphNode = 1, kGraphInitializer = 5, kGraphOutput = 12, kNodeOperator = 4, kValueName = 1;
constexpr uint64_t kTensorDims = 1, kTensorType = 2, kTensorName = 8, kTensorRawData = 9;
constexpr uint64_t kFloat32 = 1;

// The fields of a message, one after the other.
class Message {
 public:
  struct Field {
    uint64_t number = 0, value = 0;  // value: of a number
    std::string_view bytes;          // of a string or a message
  };

  explicit Message(std::string_view bytes) : rest_(bytes) {}

  std::optional<Field> Next() {
    if (rest_.empty()) return std::nullopt;
    const uint64_t tag = Varint();
    Field field{.number = tag >> 3, .value = 0, .bytes = {}};
    switch (tag & 7) {
      case 0:
        field.value = Varint();
        break;
      case 1:
        Take(8);
        break;
      case 2:
        field.bytes = Take(Varint());
        break;
      case 5:
        Take(4);
        break;
      default:
        throw std::runtime_error("it is not an ONNX file");
    }
    return field;
  }

  bool empty() const { return rest_.empty(); }

  uint64_t Varint() {
    uint64_t value = 0;
    for (int shift = 0; shift < 64; shift += 7) {
      const auto byte = uint8_t(Take(1).front());
      value |= uint64_t(byte & 0x7F) << shift;
      if ((byte & 0x80) == 0) return value;
    }
    throw std::runtime_error("it is not an ONNX file");
  }

 private:
  std::string_view Take(uint64_t n) {
    if (n > rest_.size()) throw std::runtime_error("it ends too early, or is not an ONNX file");
    const std::string_view taken = rest_.substr(0, n);
    rest_.remove_prefix(n);
    return taken;
  }

  std::string_view rest_;
};

// The string that is this field of the message; empty when there is none.
std::string StringOf(std::string_view bytes, uint64_t number) {
  Message message(bytes);
  while (const auto field = message.Next()) {
    if (field->number == number) return EscapePath(field->bytes);
  }
  return {};
}

OnnxTensor ReadTensor(std::string_view bytes) {
  OnnxTensor tensor;
  uint64_t type = 0;
  Message message(bytes);
  while (const auto field = message.Next()) {
    if (field->number == kTensorName) tensor.name = EscapePath(field->bytes);
    if (field->number == kTensorRawData) tensor.bytes = field->bytes;
    if (field->number == kTensorType) type = field->value;
    if (field->number != kTensorDims) continue;
    if (field->bytes.empty()) {
      tensor.shape.push_back(int64_t(field->value));
    } else {
      for (Message packed(field->bytes); !packed.empty();) tensor.shape.push_back(int64_t(packed.Varint()));
    }
  }
  if (type != kFloat32) throw std::runtime_error("its constant " + tensor.name + " is not of 32-bit floats");
  uint64_t left = tensor.bytes.size() / sizeof(float), n = 1;
  for (const int64_t side : tensor.shape) {
    if (side < 1 || uint64_t(side) > left / n) left = 0, n = 1;
    if (left == 0) break;
    n *= uint64_t(side);
  }
  if (left == 0 || n * sizeof(float) != tensor.bytes.size()) {
    throw std::runtime_error("its constant " + tensor.name + " has another size than its shape says");
  }
  return tensor;
}

void ReadGraph(std::string_view bytes, OnnxModel& model) {
  Message message(bytes);
  while (const auto field = message.Next()) {
    if (field->number == kGraphNode) model.operators.push_back(StringOf(field->bytes, kNodeOperator));
    if (field->number == kGraphOutput) model.outputs.push_back(StringOf(field->bytes, kValueName));
    if (field->number == kGraphInitializer) model.constants.push_back(ReadTensor(field->bytes));
  }
}

}  // namespace

OnnxModel ReadOnnx(std::string_view contents) {
  OnnxModel model;
  Message message(contents);
  while (const auto field = message.Next()) {
    if (field->number == kModelGraph) ReadGraph(field->bytes, model);
    if (field->number == kModelMetadata) {
      model.metadata[StringOf(field->bytes, kEntryKey)] = StringOf(field->bytes, kEntryValue);
    }
  }
  return model;
}

}  // namespace nrff
