// Work over many photos: by several threads, one photo each at a time, so that memory holds only as many as threads.
#pragma once

#include <cstddef>
#include <functional>
#include <string>

#include "sfm/capture.h"
#include "sfm/distortion.h"
#include "sfm/image_io.h"
#include "sfm/undistort.h"

namespace nrff {

// Calls work(0) … work(n_photos − 1), each once, by `n_threads` threads, with progress called `what`. The first
// exception ends the work and is thrown on.
void ForEachPhoto(const std::string& what, size_t n_photos, int n_threads, const std::function<void(size_t)>& work);

// The photo's pixels, oriented, with its mask as alpha. Throws InputError when one of the files changed since it was
// ingested.
Image ReadCapturedPhoto(const Capture& capture, const CaptureImage& photo);

// Resample (undistort.h) of that. Where masks say which pixels count, colours are those of the whole photo and alpha is
// the share of a pixel that counts.
Image ResampledPhoto(const Capture& capture, const CaptureImage& photo, const Lens& lens, const PinholeTarget& target);

Image WithoutAlpha(const Image& image);

}  // namespace nrff
