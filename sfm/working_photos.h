// The small copies of the photos that COLMAP works on: as their sensor had them (sensor_frame.h), scaled, one folder
// for each camera group.
#pragma once

#include <filesystem>
#include <string>

#include "sfm/capture.h"

namespace nrff {

// "CAMERA/ID.png": the copy's path, relative to the folder; also its name in COLMAP's database and models.
std::string WorkingPhotoName(const CaptureImage& photo);
// The id in such a name.
std::string IdOfWorkingPhoto(const std::string& name);

// Writes the copies that are not there yet, each atomically, as RGB PNGs (JPEG costs one feature in twenty) whose
// longer side is at most `max_size` px; pixels before a background show the capture's (black where it has none), pixels
// that do not count themselves. Masks of photos with an alpha channel go into MasksOfWorkingPhotos(dir), named as
// COLMAP wants them: NAME.png, black where no features are to be found. Throws InputError when a photo changed since it
// was ingested, ResourceError when a copy cannot be written.
std::filesystem::path MasksOfWorkingPhotos(const std::filesystem::path& dir);
void WriteWorkingPhotos(const Capture& capture, int max_size, int n_threads, const std::filesystem::path& dir);

// Size of the copy of a photo of width × height.
std::pair<int, int> WorkingSize(int width, int height, int max_size);

}  // namespace nrff
