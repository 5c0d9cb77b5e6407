// Work over many photos: by several threads, one photo each at a time, so that memory holds only as many as threads.
#pragma once

#include <cstddef>
#include <functional>
#include <string>

#include "sfm/capture.h"
#include "sfm/image_io.h"

namespace nrff {

// Calls work(0) … work(n_photos − 1), each once, by `n_threads` threads, with progress called `what`. The first
// exception ends the work and is thrown on.
void ForEachPhoto(const std::string& what, size_t n_photos, int n_threads, const std::function<void(size_t)>& work);

// The photo's pixels, oriented. Throws InputError when the file changed since it was ingested.
Image ReadCapturedPhoto(const Capture& capture, const CaptureImage& photo);

}  // namespace nrff
