// Masks: which pixels of a photo count.
//
// A mask is an image of the photo's size; pixels whose grey level is a half or more count. Masks lie in folders called
// `masks` or `mask`, under the photo's name with or without its extension (COLMAP's NAME.jpg.png, or NAME.png), at the
// photo's place beside that folder: D/masks/R is that of the photo D/R and of D/FOLDER/R. nerfstudio's transforms.json
// names them by mask_path.
#pragma once

#include <filesystem>
#include <optional>
#include <string>

#include "sfm/capture.h"
#include "sfm/image_io.h"
#include "sfm/source.h"

namespace nrff {

// Whether a file below the capture's root lies in a folder of masks.
bool IsInMaskFolder(const std::filesystem::path& relative);

// Gives the images of `source` the masks that lie below its root, where they have none yet. Masks of no photo are
// rejected by name. Throws InputError where one mask would be that of two photos.
void AttachMasks(Source& source);

// The mask's pixels become the photo's alpha channel, together with what alpha it has. Nothing changes where the mask
// counts every pixel. A mask is for the photo as it is shown; one of another size, for its stored raster where the
// photo is stored on its side (`orientation`: EXIF, of the photo). Throws InputError naming `file` when it cannot be
// read, has neither size, or counts no pixel.
void ApplyMask(const std::filesystem::path& file, int orientation, Image& photo);

}  // namespace nrff
