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
  const std::filesystem::path file = capture.root / photo.path;
  if (HashFile(file) != photo.hash)
    throw InputError(EscapePath(file) + " has changed since it was ingested: run ingest again");
  return ReadImageOriented(file, photo.info.orientation);
}

}  // namespace nrff
