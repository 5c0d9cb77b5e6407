// Extending: photos were added to a capture since a model was made of it. What the last run made of the earlier photos,
// the base, lies in the workspace's base/; a stage that is given its part of it with --base takes over what still holds
// and says in a decision (…_anew) what it took over, or why it did not.
#pragma once

#include <cstddef>
#include <filesystem>
#include <optional>
#include <string>

#include "pipeline/manifest.h"

namespace nrff {

inline constexpr char kBaseFolder[] = "base";

// The input entry for a base: the hash of all its files, since stages read some that are no payload (a checkpoint,
// COLMAP's database). Throws InputError when there is none.
HashedPath BaseInput(const std::filesystem::path& dir);

// The artifact of sfm says by this file whether its world is the base's: {"schema_version": 1, "frame_kept", …}.
inline constexpr char kExtensionFile[] = "extension.json";
inline constexpr int kExtensionSchemaVersion = 1;

// How a model of the earlier and the added photos compares with the one of the earlier photos alone.
struct MergedModel {
  size_t n_earlier = 0, n_added = 0;  // photos
  size_t n_earlier_placed = 0;        // that have a pose in the base
  size_t n_lost = 0;                  // of these: that have none now
  size_t n_added_placed = 0;
  double error_before_px = 0, error_px = 0;  // mean reprojection errors
  // How far the base's points move in the photos that see them, from their camera in the base to their camera now, once
  // both worlds are laid over each other: median over the photos. Nothing where too few are shared to tell.
  std::optional<double> shift_px;
};

namespace needs {

// COLMAP's own tolerance in matching and mapping here: an earlier point that moved by more is another one to it.
inline constexpr double kMostShift_px = 2;

// Whether such a model shows the earlier photos as well as the base does, and in its world.
bool SameWorld(const MergedModel& model);

// Poses are estimated anew where added photos cannot be placed among the earlier ones: mapping from scratch placed more
// photos, or the base's model broke. `mapped_anew`: the model is one mapped from scratch of the features and matches
// that were there.
Decision PosesAnew(const MergedModel& model, bool mapped_anew);

// The frame of the scene is chosen anew where that of the base does not suit all photos: the foreground box that they
// would be given is centred elsewhere (`centre_shift`, in half-extents of the base's) or of another size, or, in a
// bounded scene, `outside` of the points lie beyond the base's box.
Decision FrameAnew(bool same_kind, bool unbounded, double centre_shift, double scale_ratio, double outside);

// Training starts anew where `why` says that the base's model is none to go on from; else it goes on for a share of the
// steps or the time.
Decision TrainingAnew(const std::string& why, double share);

// The share of a training from scratch that one on added views takes: theirs of all training views, at least a quarter.
double TrainingShare(size_t n_views, size_t n_added);

}  // namespace needs
}  // namespace nrff
