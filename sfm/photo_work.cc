#include "sfm/photo_work.h"

#include <algorithm>
#include <atomic>
#include <exception>
#include <mutex>
#include <thread>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/progress.h"
#include "sfm/masks.h"

namespace nrff {

void ForEachPhoto(const std::string& what, size_t n_photos, int n_threads, const std::function<void(size_t)>& work) {
  Progress progress(what, double(n_photos), "photos");
  std::atomic<size_t> next = 0;
  std::mutex mutex;  // of what follows
  size_t n_done = 0;
  std::exception_ptr failure;
  const auto run = [&] {
    for (size_t i; (i = next++) < n_photos;) {
      try {
        work(i);
      } catch (...) {
        next = n_photos;
        const std::lock_guard lock(mutex);
        if (!failure) failure = std::current_exception();
        return;
      }
      const std::lock_guard lock(mutex);
      progress.Update(double(++n_done));
    }
  };
  {
    std::vector<std::jthread> threads;
    const size_t n_workers = std::min(size_t(std::max(n_threads, 1)), n_photos);
    for (size_t i = 1; i < n_workers; ++i) threads.emplace_back(run);
    run();
  }
  if (failure) std::rethrow_exception(failure);
  progress.Done();
}

Image ReadCapturedPhoto(const Capture& capture, const CaptureImage& photo) {
  const std::filesystem::path file = capture.FileOf(photo);
  if (HashFile(file) != photo.hash)
    throw InputError(EscapePath(file) + " has changed since it was ingested: run ingest again");
  Image image = ReadImageOriented(file, photo.info.orientation);
  if (photo.mask.empty()) return image;
  const std::filesystem::path mask = capture.root / photo.mask;
  if (HashFile(mask) != photo.mask_hash)
    throw InputError(EscapePath(mask) + " has changed since it was ingested: run ingest again");
  ApplyMask(mask, photo.info.orientation, image);
  return image;
}

Image ResampledPhoto(const Capture& capture, const CaptureImage& photo, const Lens& lens, const PinholeTarget& target) {
  const Image image = ReadCapturedPhoto(capture, photo);
  Image resampled = Resample(image, lens, target);
  if (resampled.channels == 3 || capture.masks == Masks::kBackground) return resampled;
  const Image colours = Resample(WithoutAlpha(image), lens, target);
  for (size_t i = 0; i < colours.pixels.size(); ++i) resampled.pixels[i / 3 * 4 + i % 3] = colours.pixels[i];
  return resampled;
}

Image WithoutAlpha(const Image& image) {
  if (image.channels == 3) return image;
  Image colours{image.width, image.height, 3, std::vector<uint8_t>(image.pixels.size() / 4 * 3)};
  for (size_t i = 0; i < colours.pixels.size(); ++i) colours.pixels[i] = image.pixels[i / 3 * 4 + i % 3];
  return colours;
}

}  // namespace nrff
