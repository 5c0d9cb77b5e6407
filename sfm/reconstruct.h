// One attempt at a reconstruction: working photos, features, matching of chosen pairs, incremental mapping.
//
// Everything is kept below the attempt's folder and used again by an attempt that goes on from it: photos already
// scaled, features already extracted, pairs already matched, a reconstruction already finished.
//
// Photos of a group (Capture) share a camera. Where nothing better is known of a lens it is a SIMPLE_RADIAL one of the
// focal length that the photos give.
#pragma once

#include <filesystem>
#include <functional>
#include <map>
#include <set>
#include <string>

#include "pipeline/manifest.h"
#include "sfm/attempt.h"
#include "sfm/capture.h"
#include "sfm/colmap_model.h"
#include "sfm/colmap_runner.h"
#include "sfm/sfm_settings.h"

namespace nrff {

// What a reconstruction of fewer of the capture's photos left, under the same ids.
struct EarlierMapping {
  std::filesystem::path database, model;  // the database is copied, never opened
  std::set<std::string> photos;           // in the database: WorkingPhotoName
  // Whether the model grown by the added photos holds; if not, or where it lacks photos, all are mapped from scratch.
  std::function<bool(const ColmapModel& grown)> holds;
};

// Throws what Colmap throws; a mapper that finds no model is no failure. Where photos stay outside of the largest
// model, pairs of them with it are matched, too, and if any of these hold, mapping is done again: pieces that were
// joined by too few pairs become one.
//
// With an earlier mapping (whose settings these have to be) features of added photos alone are found, pairs with an
// added photo alone are matched, and the earlier model grows by them; `models` is then empty where nothing more was
// tried.
Attempt Reconstruct(const Capture& capture, const SfmSettings& settings, Colmap& colmap,
                    const std::filesystem::path& dir, const ArtifactWriter& artifact,
                    const EarlierMapping* earlier = nullptr);

// The attempt `before`, of the folder `dir`, from its matches on with the lenses that its settings now know: verified
// again, mapped again. Groups without one keep the lens they had. `name`: of its files below `dir`.
Attempt ReconstructWithLenses(const Capture& capture, const Attempt& before, const std::string& name, Colmap& colmap,
                              const std::filesystem::path& dir, const ArtifactWriter& artifact);

// The attempt `before` mapped again from its verified matches, images with the cameras of their own that are given by
// their ids; others share theirs as before. `name`: of its files beside `before`'s database.
Attempt ReconstructWithOwnCameras(const Capture& capture, const Attempt& before,
                                  const std::map<uint32_t, ColmapCamera>& by_image, const std::string& name,
                                  Colmap& colmap, const ArtifactWriter& artifact);

}  // namespace nrff
