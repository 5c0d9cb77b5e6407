// The pose stage: from a capture and a COLMAP model of it to the scene that training reads.
//
//   scene.json, images.u8   pipeline/scene.h
//   depths.bin              sparse depths on rays of training views: pipeline/scene.h, sparse_depth.h
//   points.ply              sparse points: binary little endian, float x y z (scene frame), uchar red green blue
//   sparse/*.txt            COLMAP text model, world frame, the pinhole cameras of the pack, images named by their path
//   transforms.json         the same cameras in nerfstudio's form
//
// Views without a pose are left out and listed. Photos are read one at a time by each thread.
#pragma once

#include <filesystem>
#include <optional>

#include "pipeline/manifest.h"
#include "pipeline/scene.h"

namespace nrff {

struct PoseOptions {
  int max_image_size = kMaxImageSize;  // px, longer side
  std::optional<bool> undistortion;    // forced either way
  std::optional<bool> contraction;     // forced either way
  std::filesystem::path base;          // a pose artifact whose frame is kept where it suits all photos; empty: none
  int n_threads = 1;
};

// `ingest_dir` holds capture.json, `model_dir` the COLMAP model whose image names are the capture's ids. Writes
// payload, facts and decisions. The base's frame is kept where extension.json beside `model_dir` says that the model is
// in its world, and DecideFrame that it suits. Throws InputError when a photo changed since it was ingested, when its
// camera is of another size, or when fewer than two training views have a pose; ResourceError when the pack does not
// fit the disk.
void WriteScene(const std::filesystem::path& ingest_dir, const std::filesystem::path& model_dir,
                const PoseOptions& options, ArtifactWriter& artifact);

}  // namespace nrff
