// The two encodings of COLMAP's sparse models; `colmap_model.h` is what others use.
//
// Readers fill one model from three files and check syntax and bounds; `ReadColmapModel` checks what holds between
// the files. All throw InputError naming the file and the place.
#pragma once

#include <filesystem>
#include <string>

#include "sfm/colmap_model.h"

namespace nrff {

ColmapModel ReadColmapBinary(const std::filesystem::path& dir);
ColmapModel ReadColmapText(const std::filesystem::path& dir);

// Adds what was read, after checking it by itself: number ranges, finiteness, ids not seen before. `where` is the file
// and place for the error's text.
void AddCamera(ColmapModel& model, ColmapCamera camera, const std::string& where);
void AddImage(ColmapModel& model, ColmapImage image, const std::string& where);
void AddPoint(ColmapModel& model, uint64_t id, ColmapPoint point, const std::string& where);

}  // namespace nrff
