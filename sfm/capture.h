// The capture: which photos there are, how they were taken, which are held out. Written by ingest as capture.json
// (schema in ARCHITECTURE.md), read by all pose work. It refers to the photos where they lie and never changes them.
#pragma once

#include <array>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/scene.h"
#include "sfm/image_io.h"

namespace nrff {

// What masks and alpha channels say of the pixels that they leave out: these do not count, or show what is behind the
// subject.
enum class Masks { kIgnore, kBackground };

struct CaptureImage {
  std::string id;              // "000012": position in byte order of `path`, added photos (ingest.h) after all others
  std::filesystem::path path;  // relative to Capture::root or, of a frame of a video, to the ingest artifact
  bool extracted = false;      // is a frame of a video
  Split split = Split::kTrain;
  ImageInfo info;                // info.orientation is the one to apply: 1 where poses refer to the stored raster
  std::string hash;              // of the file's bytes
  std::filesystem::path mask{};  // as path (masks.h); empty: none
  std::string mask_hash{};
  int camera = 0;   // group: same make, model, focal length and size (SensorSize)
  double blur = 0;  // MeasureBlur (image_measures.h)

  std::string Name() const;  // the file's name, escaped (EscapePath)
};

struct RejectedFile {
  std::string name;    // relative to the root, escaped
  std::string reason;  // one clause
};

struct Capture {
  std::string name;
  std::string kind;                      // photos | transforms | nsvf | colmap
  std::filesystem::path root, artifact;  // the folder as the user has it; the ingest artifact, in no file
  std::string split_rule;
  bool posed = false;
  bool ordered = false;  // byte order of the names is the order of taking (IsOrdered)
  Background background = Background::kNone;
  Masks masks = Masks::kBackground;          // info.channels says which photos have any
  std::optional<std::array<double, 6>> box;  // min xyz, max xyz, world units
  std::vector<CaptureImage> images;          // by id
  std::vector<RejectedFile> rejected;
  std::filesystem::path FileOf(const CaptureImage& image) const {
    return (image.extracted ? artifact : root) / image.path;
  }
  std::vector<std::vector<std::string>> duplicates;  // groups of photos that look alike, escaped relative paths
};

inline constexpr int kCaptureSchemaVersion = 2;
inline constexpr char kCaptureFile[] = "capture.json";
inline constexpr char kGivenModelDir[] = "sparse";  // beside capture.json, where the capture brings poses

// Places of paths in their byte order, which is that of taking where a capture is `ordered`.
std::vector<size_t> OrderByPath(const std::vector<std::filesystem::path>& paths);

// "ignore" or "background".
const char* MasksName(Masks masks);

void SaveCapture(const Capture& capture, const std::filesystem::path& dir);
// Throws CorruptError naming file and key.
Capture LoadCapture(const std::filesystem::path& dir);

}  // namespace nrff
