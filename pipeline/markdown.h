// Cells of Markdown tables.
#pragma once

#include <string>

#include "pipeline/json.h"

namespace nrff {

// The number in fmt's `format`; a dash where there is none.
std::string Figure(const Json& value, const char* format);

// {mean, least, most} (trainings.h) as "mean (least to most)", or as one number where they are equal; a dash for null.
std::string BandText(const Json& band, const char* format);

// Text that a cell can hold; a dash for nothing.
std::string CellText(const Json& value);

}  // namespace nrff
