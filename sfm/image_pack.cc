#include "sfm/image_pack.h"

#include <fcntl.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "sfm/photo_work.h"

namespace nrff {
namespace {

class PackFile {
 public:
  PackFile(const std::filesystem::path& path, uint64_t size_bytes) : path_(path) {
    fd_ = open(path.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0666);
    if (fd_ < 0) throw Failure(errno);
    if (const int error = size_bytes > 0 ? posix_fallocate(fd_, 0, off_t(size_bytes)) : 0; error != 0) {
      close(fd_);
      throw Failure(error);
    }
  }
  ~PackFile() { close(fd_); }
  PackFile(const PackFile&) = delete;
  PackFile& operator=(const PackFile&) = delete;

  void Write(uint64_t offset, const std::vector<uint8_t>& bytes) {
    for (size_t done = 0; done < bytes.size();) {
      const ssize_t n = pwrite(fd_, bytes.data() + done, bytes.size() - done, off_t(offset + done));
      if (n < 0 && errno == EINTR) continue;
      if (n < 0) throw Failure(errno);
      done += size_t(n);
    }
  }

 private:
  Error Failure(int error) const {
    return ResourceError("cannot write " + EscapePath(path_) + ": " + std::strerror(error) +
                         "; free some space or use a smaller --max-image-size");
  }
  std::filesystem::path path_;
  int fd_ = -1;
};

}  // namespace

void WriteImagePack(const std::filesystem::path& file, uint64_t size_bytes, const Capture& capture,
                    const std::vector<PackEntry>& entries, int n_threads) {
  PackFile pack(file, size_bytes);
  ForEachPhoto("packing photos", entries.size(), n_threads, [&](size_t i) {
    const PackEntry& entry = entries[i];
    pack.Write(entry.offset, ResampledPhoto(capture, *entry.photo, *entry.lens, *entry.target).pixels);
  });
}

}  // namespace nrff
