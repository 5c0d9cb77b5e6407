// What can be told of an ONNX file without running it: enough to check one before it is used, and to read constants
// that no node uses. Reads protobuf's wire format itself, as the message types that are needed have a handful of
// fields.
#pragma once

#include <cstdint>
#include <map>
#include <string>
#include <string_view>
#include <vector>

namespace nrff {

// Names and metadata are escaped (EscapePath), as they go into messages and manifests.
struct OnnxTensor {
  std::string name;
  std::vector<int64_t> shape;
  std::string_view bytes;  // float32, little endian; of the file's contents
};

struct OnnxModel {
  std::map<std::string, std::string> metadata;  // metadata_props
  std::vector<std::string> operators;           // of the nodes, in order
  std::vector<OnnxTensor> constants;            // the graph's initializers, in order
  std::vector<std::string> outputs;             // of the graph, in order
};

// contents: of the file, which must outlive the model. Throws std::runtime_error saying what is wrong: no protobuf, a
// constant that is not of float32 in raw_data or whose size is not its shape's.
OnnxModel ReadOnnx(std::string_view contents);

}  // namespace nrff
