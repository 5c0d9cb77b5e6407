// Reference values of the model, as a safetensors file holds them (the form is described where the tests read it:
// tests/reference_test.cc), and the ways between the authors' parameter names and NrffField's.
#pragma once

#include <torch/types.h>

#include <functional>
#include <map>
#include <string>

#include "model/nrff_field.h"
#include "model/safetensors.h"
#include "tests/oracle.h"

namespace nrff::testing {

// One tensor of the file, F32, F64, U8 or I64, as double (U8: as bool).
torch::Tensor ReadTensor(const SafetensorsFile& file, const std::string& name);

// All tensors below a prefix, by the rest of their name.
std::map<std::string, torch::Tensor> ReadTensors(const SafetensorsFile& file, const std::string& prefix);

OracleSettings ReadOracleSettings(const SafetensorsFile& file);
// Sizes from the parameters' shapes.
FieldConfig ReadFieldConfig(const SafetensorsFile& file);

// Calls visit(authors' name, view) for every part of the field's parameters, where `view` is the matching part of
// values[i] (same shape as field.parameters()[i]) in the authors' shape.
void ForEachPart(const NrffField& field, const std::vector<torch::Tensor>& values,
                 const std::function<void(const std::string&, const torch::Tensor&)>& visit);

}  // namespace nrff::testing
