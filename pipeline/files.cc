#include "pipeline/files.h"

#include <fcntl.h>
#include <linux/fs.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <set>
#include <utility>

#define XXH_INLINE_ALL
#include <xxhash.h>

#include "pipeline/error.h"
#include "pipeline/photo_name.h"

namespace nrff {
namespace fs = std::filesystem;
namespace {

constexpr size_t kLongestFileName = 200;   // file systems allow 255 bytes
constexpr char kTemporaryMark[] = ".tmp";  // before the process's number

std::string ErrnoText() { return std::strerror(errno); }

// A descriptor that closes itself.
class Descriptor {
 public:
  explicit Descriptor(int fd) : fd_(fd) {}
  ~Descriptor() {
    if (fd_ >= 0) close(fd_);
  }
  Descriptor(const Descriptor&) = delete;
  Descriptor& operator=(const Descriptor&) = delete;
  int get() const { return fd_; }
  // Closes now and reports what the close said.
  bool Close() { return close(std::exchange(fd_, -1)) == 0; }

 private:
  int fd_;
};

std::string Hex(const XXH128_hash_t& hash) {
  XXH128_canonical_t canonical;
  XXH128_canonicalFromHash(&canonical, hash);
  static constexpr char kDigits[] = "0123456789abcdef";
  std::string text;
  for (unsigned char byte : canonical.digest) {
    text += kDigits[byte >> 4];
    text += kDigits[byte & 15];
  }
  return text;
}

// Length of the valid UTF-8 sequence at `text`, 0 when there is none (RFC 3629: no surrogates, no overlong forms).
size_t Utf8SequenceLength(std::string_view text) {
  const auto byte = [&](size_t i) { return static_cast<unsigned char>(text[i]); };
  const unsigned char lead = byte(0);
  if (lead < 0x80) return 1;
  const size_t length = lead >= 0xC2 && lead < 0xE0   ? 2
                        : lead >= 0xE0 && lead < 0xF0 ? 3
                        : lead >= 0xF0 && lead < 0xF5 ? 4
                                                      : 0;
  if (length == 0 || text.size() < length) return 0;
  for (size_t i = 1; i < length; ++i) {
    if ((byte(i) & 0xC0) != 0x80) return 0;
  }
  if (lead == 0xE0 && byte(1) < 0xA0) return 0;
  if (lead == 0xED && byte(1) >= 0xA0) return 0;
  if (lead == 0xF0 && byte(1) < 0x90) return 0;
  if (lead == 0xF4 && byte(1) >= 0x90) return 0;
  return length;
}

void ListInto(const fs::path& dir, std::set<std::pair<dev_t, ino_t>>& visited, std::vector<fs::path>& files) {
  struct stat info {};
  if (stat(dir.c_str(), &info) != 0 || !visited.emplace(info.st_dev, info.st_ino).second) return;
  std::error_code error;
  if (fs::exists(dir / kWorkspaceMarker, error)) return;
  for (fs::directory_iterator it(dir, fs::directory_options::skip_permission_denied, error), end; !error && it != end;
       it.increment(error)) {
    if (it->path().filename().native().front() == '.') continue;
    std::error_code status_error;
    const fs::file_status status = it->status(status_error);  // follows links; a loop is an error
    if (status_error) continue;
    if (fs::is_directory(status)) {
      ListInto(it->path(), visited, files);
    } else if (fs::is_regular_file(status)) {
      files.push_back(it->path());
    }
  }
}

}  // namespace

std::string ReadFile(const fs::path& path) {
  const Descriptor file(open(path.c_str(), O_RDONLY | O_CLOEXEC));
  if (file.get() < 0) throw InputError("cannot open " + EscapePath(path) + ": " + ErrnoText());
  std::string bytes;
  struct stat info {};
  if (fstat(file.get(), &info) == 0 && info.st_size > 0) bytes.reserve(static_cast<size_t>(info.st_size));
  char buffer[1 << 16];
  for (;;) {
    const ssize_t n = read(file.get(), buffer, sizeof buffer);
    if (n == 0) return bytes;
    if (n < 0 && errno == EINTR) continue;
    if (n < 0) throw InputError("cannot read " + EscapePath(path) + ": " + ErrnoText());
    bytes.append(buffer, static_cast<size_t>(n));
  }
}

void WriteFileAtomically(const fs::path& path, std::string_view bytes) {
  const fs::path temporary = path.native() + kTemporaryMark + std::to_string(getpid());
  const auto fail = [&](const char* what) {
    const std::string reason = ErrnoText();
    unlink(temporary.c_str());
    throw ResourceError(std::string("cannot ") + what + " " + EscapePath(path) + ": " + reason +
                        "; free some space or choose another workspace");
  };
  Descriptor file(open(temporary.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0666));
  if (file.get() < 0) fail("create");
  while (!bytes.empty()) {
    const ssize_t n = write(file.get(), bytes.data(), bytes.size());
    if (n < 0 && errno == EINTR) continue;
    if (n < 0) fail("write");
    bytes.remove_prefix(static_cast<size_t>(n));
  }
  if (fsync(file.get()) != 0 || !file.Close()) fail("write");
  if (rename(temporary.c_str(), path.c_str()) != 0) fail("rename");
  SyncPath(path.has_parent_path() ? path.parent_path() : fs::path("."));
}

void RemoveTemporaries(const fs::path& root) {
  std::vector<fs::path> temporaries;
  for (const auto& entry : fs::recursive_directory_iterator(root)) {
    const std::string name = entry.path().filename();
    const size_t mark = name.rfind(kTemporaryMark);
    const size_t digits = mark == std::string::npos ? mark : mark + std::strlen(kTemporaryMark);
    if (mark != std::string::npos && digits < name.size() &&
        name.find_first_not_of("0123456789", digits) == std::string::npos) {
      temporaries.push_back(entry.path());
    }
  }
  for (const fs::path& temporary : temporaries) fs::remove(temporary);
}

void SyncPath(const fs::path& path) {
  const Descriptor file(open(path.c_str(), O_RDONLY | O_CLOEXEC));
  // Some file systems cannot sync a directory (EINVAL): nothing more can be done there.
  if (file.get() < 0 || (fsync(file.get()) != 0 && errno != EINVAL)) {
    throw ResourceError("cannot flush " + EscapePath(path) + " to the disk: " + ErrnoText());
  }
}

void ReplaceDirectory(const fs::path& fresh, const fs::path& target) {
  const fs::path parent = target.has_parent_path() ? target.parent_path() : fs::path(".");
  if (rename(fresh.c_str(), target.c_str()) == 0) {  // target absent or empty
    SyncPath(parent);
    return;
  }
  if (errno != ENOTEMPTY && errno != EEXIST) {
    throw ResourceError("cannot rename " + EscapePath(fresh) + " to " + EscapePath(target) + ": " + ErrnoText());
  }
  if (syscall(SYS_renameat2, AT_FDCWD, fresh.c_str(), AT_FDCWD, target.c_str(), RENAME_EXCHANGE) == 0) {
    SyncPath(parent);
    fs::remove_all(fresh);  // now holds what target held
    return;
  }
  // No exchange on this file system: two renames, with a moment in which target is absent.
  const fs::path old = target.native() + ".old";
  fs::remove_all(old);
  if (rename(target.c_str(), old.c_str()) != 0 || rename(fresh.c_str(), target.c_str()) != 0) {
    throw ResourceError("cannot replace " + EscapePath(target) + ": " + ErrnoText());
  }
  SyncPath(parent);
  fs::remove_all(old);
}

std::string HashBytes(std::string_view bytes) { return Hex(XXH3_128bits(bytes.data(), bytes.size())); }

std::string HashFile(const fs::path& path) {
  const Descriptor file(open(path.c_str(), O_RDONLY | O_CLOEXEC));
  if (file.get() < 0) throw InputError("cannot open " + EscapePath(path) + ": " + ErrnoText());
  XXH3_state_t state;
  XXH3_128bits_reset(&state);
  std::vector<char> buffer(1 << 20);
  for (;;) {
    const ssize_t n = read(file.get(), buffer.data(), buffer.size());
    if (n == 0) return Hex(XXH3_128bits_digest(&state));
    if (n < 0 && errno == EINTR) continue;
    if (n < 0) throw InputError("cannot read " + EscapePath(path) + ": " + ErrnoText());
    XXH3_128bits_update(&state, buffer.data(), static_cast<size_t>(n));
  }
}

std::vector<fs::path> ListFiles(const fs::path& root) {
  std::vector<fs::path> files;
  std::error_code error;
  if (fs::is_regular_file(root, error)) {
    files.push_back(root);
    return files;
  }
  std::set<std::pair<dev_t, ino_t>> visited;
  ListInto(root, visited, files);
  std::sort(files.begin(), files.end(), [](const fs::path& a, const fs::path& b) { return a.native() < b.native(); });
  return files;
}

std::string HashTree(const fs::path& root) {
  std::error_code error;
  if (!fs::exists(root, error)) throw InputError(EscapePath(root) + " does not exist: give a capture's folder");
  if (fs::is_regular_file(root, error)) return HashFile(root);
  std::string listing;
  for (const fs::path& file : ListFiles(root)) {
    std::string content;
    try {
      content = HashFile(file);
    } catch (const Error&) {
      content = "unreadable";  // whoever needs the file reports it by name
    }
    listing += EscapePath(file.lexically_relative(root)) + '\n' + content + '\n';
  }
  return HashBytes(listing);
}

fs::path CaptureFolderName(const fs::path& capture) {
  if (HasVideoExtension(capture)) return capture.stem();
  const fs::path name = capture.filename();
  const bool generic = name == "images" || name == "photos" || name == "input" || name == "frames";
  const fs::path parent = capture.parent_path().filename();
  return generic && !parent.empty() ? parent : name;
}

bool IsFileName(std::string_view name) {
  const bool plain = std::none_of(name.begin(), name.end(), [](unsigned char c) { return c < 0x20 || c == '/'; });
  return plain && !name.empty() && name.size() <= kLongestFileName && name != "." && name != "..";
}

std::string EscapePath(const fs::path& path) {
  static constexpr char kDigits[] = "0123456789ABCDEF";
  std::string_view rest = path.native();
  std::string text;
  while (!rest.empty()) {
    const auto byte = static_cast<unsigned char>(rest[0]);
    const size_t length = Utf8SequenceLength(rest);
    if (length == 0 || byte < 0x20 || byte == 0x7F || byte == '%') {
      text += {'%', kDigits[byte >> 4], kDigits[byte & 15]};
      rest.remove_prefix(1);
    } else {
      text += rest.substr(0, length);
      rest.remove_prefix(length);
    }
  }
  return text;
}

fs::path UnescapePath(std::string_view text) {
  const auto digit = [](char c) { return c >= '0' && c <= '9' ? c - '0' : c >= 'A' && c <= 'F' ? c - 'A' + 10 : -1; };
  std::string bytes;
  for (size_t i = 0; i < text.size(); ++i) {
    if (text[i] == '%' && i + 2 < text.size() && digit(text[i + 1]) >= 0 && digit(text[i + 2]) >= 0) {
      bytes += static_cast<char>(digit(text[i + 1]) * 16 + digit(text[i + 2]));
      i += 2;
    } else {
      bytes += text[i];
    }
  }
  return bytes;
}

}  // namespace nrff
