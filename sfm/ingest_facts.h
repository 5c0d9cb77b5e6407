// What ingest says of a capture: in its manifest's facts, in the log.
#pragma once

#include "pipeline/json.h"
#include "sfm/capture.h"

namespace nrff {

Json IngestFacts(const Capture& capture, int n_cameras);
void LogIngestFacts(const Capture& capture, const Json& facts);

}  // namespace nrff
