// A model of the working photos (working_photos.h) as one of the capture's photos, as the rest of the pipeline wants
// it.
#pragma once

#include "sfm/capture.h"
#include "sfm/colmap_model.h"

namespace nrff {

// Images named by id, cameras and observations of the photos' own size, errors in their px; still as sensors had them.
// Throws CorruptError for an image that is none of the capture's, or whose copy has another orientation.
ColmapModel AtFullSize(const ColmapModel& working, const Capture& capture);

// Such a model turned as the photos are displayed. A camera of photos turned otherwise becomes one for each turn.
ColmapModel AsDisplayed(const ColmapModel& full_size, const Capture& capture);

}  // namespace nrff
