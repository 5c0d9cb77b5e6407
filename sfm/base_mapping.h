// What an estimate of poses leaves for one that has photos added to it, and what that makes of it.
#pragma once

#include <filesystem>
#include <optional>
#include <set>
#include <string>

#include "pipeline/json.h"
#include "pipeline/manifest.h"
#include "sfm/capture.h"
#include "sfm/colmap_model.h"
#include "sfm/colmap_runner.h"
#include "sfm/reconstruct.h"

namespace nrff {

// Of an estimate's artifact: database.db, settings.json, model/*.bin, which COLMAP can go on from, and, where photos
// were given focal lengths of their own, exported/*.bin, the model with these, in whose world the poses are.
inline constexpr char kMappingDir[] = "mapping";

// Models of the working photos; `own_focal` may be null. `asked`: the options that decide which features and lenses
// there are.
void KeepMapping(const Attempt& attempt, const ColmapModel& shared, const ColmapModel* own_focal, const Json& asked,
                 const std::filesystem::path& dir);

struct BaseMapping {
  SfmSettings settings;
  EarlierMapping mapping;
  ColmapModel model;     // as COLMAP can go on from it
  ColmapModel exported;  // the one in whose world the base's poses are
  bool own_focal_lengths = false;
  std::set<std::string> photos;  // working names
};

// Of the artifact `base_dir`. Nothing, with a warning, where it was asked for otherwise. Throws CorruptError naming the
// file that cannot be used.
std::optional<BaseMapping> ReadBaseMapping(const std::filesystem::path& base_dir, const Json& asked);

// Whether the model, to be exported, can be laid over the base's exported one (needs::SameWorld).
bool IsInBasesWorld(const BaseMapping& base, const Capture& capture, const ColmapModel& model);

// Whether what the extending attempt came to is a model mapped from scratch.
bool MappedAnew(const Attempt& attempt);

// The base's model grown by the added photos, and, where that does not hold, what is mapped anew. Throws what Colmap
// throws.
Attempt Extend(const BaseMapping& base, SfmSettings settings, const Capture& capture, Colmap& colmap,
               const std::filesystem::path& work, const ArtifactWriter& artifact);

// `model`, as it is to be exported, in the base's world where the two can be laid over each other. Writes
// extension.json (estimate.h), its fact and the decision.
ColmapModel InBasesWorld(const BaseMapping& base, const Capture& capture, const Attempt& attempt, ColmapModel model,
                         ArtifactWriter& artifact);

}  // namespace nrff
