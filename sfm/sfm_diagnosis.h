// Why a reconstruction failed, in the user's terms.
#pragma once

#include <string>

#include "sfm/capture.h"
#include "sfm/colmap_database.h"
#include "sfm/colmap_model.h"

namespace nrff {

// `model`: the largest one found, nullptr if there is none; image names are those of the working photos.
std::string DiagnoseRegistration(const Capture& capture, const ColmapDatabase& database, const ColmapModel* model);

}  // namespace nrff
