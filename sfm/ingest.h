// Ingest: from a folder as the user has it to the capture that all later stages read. Decides which photos are used and
// which are held out, before any pose is estimated; never writes to the folder.
#pragma once

#include <filesystem>
#include <optional>

#include "pipeline/json.h"
#include "pipeline/manifest.h"
#include "sfm/capture.h"

namespace nrff {

// What the first look at a capture says, without decoding pixels: {"kind", "name", "n_images", "posed", "split_rule",
// "has_alpha", "n_train", "n_test"}. Damaged photos still count, and has_alpha may come from an alpha channel that is
// opaque everywhere. `base`: of an earlier ingest, or empty; then also {"extension": {"n_earlier", "n_added"} or null,
// "why_anew": why it is null, or null}.
Json ProbeCapture(const std::filesystem::path& capture, const std::filesystem::path& base = {});

// The artifact's one input: the folder's absolute path and the hash of all files in it.
HashedPath CaptureInput(const std::filesystem::path& capture);

// Recognises the capture (recognise.h), decodes every photo with `n_threads` threads, rejects those that cannot be used
// by name and reason, freezes the hold-out, and writes capture.json, the given poses as sparse/*.bin, facts and
// decisions.
//
// Hold-out: the data set's own split where it has one, else every 8th (index % 8 == 0) in byte order of the paths over
// the photos that can be used. Unposed byte-identical copies are rejected; photos that look alike are only reported.
// Throws InputError when fewer than kMinImages are left.
//
// An ingest of the same capture with fewer photos, `base`, is extended where all its photos are there unchanged: they
// keep their ids and sides, those added count on from them, in byte order of their paths, by the same rule. Fact
// "extension": {"n_earlier", "n_added"}; where it is null, "why_anew" says why.
//
// Masks (masks.h): `masks` says what they and alpha channels mean; nothing: masks leave out pixels that do not count,
// alpha channels without masks the background.
struct IngestOptions {
  std::optional<Masks> masks;
  bool without_masks = false;       // they are not looked at
  int frames = 0;                   // of each video; 0: as far apart as the picture moves (frame_choice.h)
  std::filesystem::path base = {};  // an ingest artifact; empty: none
  int n_threads = 1;
};
void Ingest(const std::filesystem::path& capture, const IngestOptions& options, ArtifactWriter& artifact);

inline constexpr int kMinImages = 3;  // two to reconstruct from, one held out
inline constexpr int kHoldOutEvery = 8;

}  // namespace nrff
