// What holds of poses and cameras however they were read.
#pragma once

#include "sfm/colmap_model.h"
#include "sfm/source.h"

namespace nrff::fuzz {

// Rotations are equal to rounding, as reading normalises them; everything else exactly.
void RequireSame(const ColmapModel& a, const ColmapModel& b);

// Of a capture that brings its poses: they are finite, there is a photo to each, and the model that ingest writes of
// them can be read.
void RequireUsable(const Source& source);

}  // namespace nrff::fuzz
