// Files: whole-file reading, atomic writing, content hashes, names that may hold any byte.
#pragma once

#include <cstdint>
#include <filesystem>
#include <string>
#include <string_view>
#include <vector>

namespace nrff {

// Throws InputError naming the file when it cannot be read.
std::string ReadFile(const std::filesystem::path& path);

// Writes to a temporary name beside `path`, fsyncs, renames. After a crash at any moment `path` holds either its
// old bytes or the new ones. Throws ResourceError (disk full, no permission) naming the file.
void WriteFileAtomically(const std::filesystem::path& path, std::string_view bytes);

// Removes what WriteFileAtomically leaves below `root` when its process is killed while it writes.
void RemoveTemporaries(const std::filesystem::path& root);

// Flushes a file's or a directory's own metadata to the disk.
void SyncPath(const std::filesystem::path& path);

// Makes the directory `fresh` take the place of `target` (which may exist); what `target` held before is removed
// only after the exchange.
void ReplaceDirectory(const std::filesystem::path& fresh, const std::filesystem::path& target);

// XXH3-128 in 32 hex digits.
std::string HashBytes(std::string_view bytes);
std::string HashFile(const std::filesystem::path& path);

// Regular files below `root` (or `root` itself when it is one), in byte order of their relative path. Symbolic links
// are followed, loops and repeated directories visited once. Directories that hold a workspace (`kWorkspaceMarker`),
// hidden files and unreadable directories are passed over.
std::vector<std::filesystem::path> ListFiles(const std::filesystem::path& root);

// Hash over (relative path, content hash) of every file `ListFiles` finds; a file that cannot be read counts by its
// name. Throws InputError when `root` is absent.
std::string HashTree(const std::filesystem::path& root);

inline constexpr char kWorkspaceMarker[] = "nrff-workspace.json";

// What people call a capture: its folder's name, or the parent's where the folder only says what is in it ("images",
// "photos", "input", "frames").
std::filesystem::path CaptureFolderName(const std::filesystem::path& capture);

// Whether files may be called so in any folder: not empty, no path, no control characters, room for an extension.
bool IsFileName(std::string_view name);

// Reversible text form of a file name that may hold any byte: '%', control characters and bytes that are not valid
// UTF-8 become %XX. What JSON files, logs and reports show.
std::string EscapePath(const std::filesystem::path& path);
std::filesystem::path UnescapePath(std::string_view text);

}  // namespace nrff
