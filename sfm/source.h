// What a capture's own files say, before any photo is decoded: the common form that every format is read into.
#pragma once

#include <Eigen/Core>
#include <array>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/error.h"
#include "sfm/capture.h"
#include "sfm/colmap_model.h"

namespace nrff {

struct SourceImage {
  std::filesystem::path path;    // relative to Source::root
  std::optional<Split> split;    // where the data set has one of its own
  std::filesystem::path mask{};  // as path (masks.h); empty: none
  bool extracted = false;        // from a video: path is relative to the ingest artifact
  std::string video{};           // then: its name, escaped
};

struct Source {
  std::string kind;             // photos | transforms | nsvf | colmap
  std::string evidence;         // what it was recognised by: "transforms.json with 67 frames"
  std::string name;             // of the capture, escaped
  std::filesystem::path given;  // the folder or the video
  std::filesystem::path root;
  std::vector<std::filesystem::path> videos;  // relative to root; their frames become images (video.h)
  std::vector<SourceImage> images;            // RecogniseCapture sorts them by path and rejects what is named twice
  std::vector<RejectedFile> rejected;
  // Poses, where given: image names are the paths of `images` (their bytes), in the capture's world frame. The cameras'
  // sizes are those that the poses were made for; the photos may have been resized since.
  std::optional<ColmapModel> model;
  bool poses_ignore_orientation = false;      // poses are for the stored raster, as COLMAP reads it
  Background background = Background::kNone;  // what the data set's loader composites onto; alpha implies white anyway
  std::optional<std::array<double, 6>> box;   // min xyz, max xyz, world units
};

// Adds an image with its pose, sharing the camera with an earlier image where it is the same one (its id is set here).
// `world_from_camera`: OpenCV axes. Throws InputError beginning with `where` unless it is finite, and its rotation
// orthonormal (to 1e-3) and right-handed.
void AddPosedImage(Source& source, const SourceImage& image, ColmapCamera camera,
                   const Eigen::Matrix4d& world_from_camera, const std::string& where);

// Throws InputError beginning with `where` unless `matrix` is finite and rigid (to 1e-3) with a right-handed rotation.
void CheckRigid(const Eigen::Matrix4d& matrix, const std::string& where);

// The camera of an image that was resized to width × height.
ColmapCamera ScaledCamera(const ColmapCamera& camera, int width, int height);

// The entry for a photo that reading ended with `error` for: the error's text without the file's name.
RejectedFile Rejection(const std::filesystem::path& root, const std::filesystem::path& path, const Error& error);

// Whether a regular file (or a link to one) is there; false, too, for names that no file can have and for link loops.
bool IsFile(const std::filesystem::path& path);

// `stem` itself or with a photo's extension appended, whichever is a file below `root`; empty where none is.
std::filesystem::path FindPhoto(const std::filesystem::path& root, const std::filesystem::path& stem);

}  // namespace nrff
