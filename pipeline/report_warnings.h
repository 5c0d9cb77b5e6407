// What a reader of a report has to know before trusting its figures.
#pragma once

#include "pipeline/json.h"
#include "pipeline/report_summary.h"

namespace nrff {

// [{kind, text, items: [text]}], gravest first.
Json Warnings(const WorkspaceState& state);

}  // namespace nrff
