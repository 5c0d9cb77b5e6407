// A COLMAP model with its photos beside it: sparse/0 (or sparse/, colmap/sparse/0, the folder itself) and images/ (or
// input/, the folder itself, images_2/, images_4/, images_8/). Of several models in sparse/ the one with the most
// images is taken.
#pragma once

#include <filesystem>
#include <optional>

#include "sfm/source.h"

namespace nrff {

// Nothing where `root` holds no model. Images of the model without a photo, and photos without a pose, are rejected by
// name. Throws InputError where there is a model but none of its photos.
std::optional<Source> ReadColmapSource(const std::filesystem::path& root);

}  // namespace nrff
