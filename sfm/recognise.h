// What kind of capture a folder holds. Nothing is declared by the user: the files tell.
//
//   transforms  transforms.json, or transforms_train.json with transforms_test.json      (transforms_json.h)
//   nsvf        intrinsics.txt and pose/                                                  (nsvf.h)
//   colmap      a COLMAP model with its photos                                            (colmap_source.h)
//   photos      files named like photos, in sub-folders too, and videos; or one video alone
//
// The first that fits is taken: poses win over photos, explicit splits over none.
#pragma once

#include <filesystem>

#include "sfm/source.h"

namespace nrff {

// Images come in byte order of their paths. Decodes no pixels. Throws InputError naming the folder, what was found in
// it and what was expected.
Source RecogniseCapture(const std::filesystem::path& root);

}  // namespace nrff
