// The heavy parts of a report's page: pictures as data URIs, sparse points and cameras.
#pragma once

#include <vector>

#include "pipeline/json.h"
#include "pipeline/report_summary.h"

namespace nrff {

// Pictures are embedded as they are on disk. Up to kMaxPictureViews views of at most kMaxPictureSidePx and
// kMaxPictureBytes together are shown; of more, larger or heavier ones the worst, the median and the best by PSNR.
inline constexpr size_t kMaxPictureViews = 24;
inline constexpr int kMaxPictureSidePx = 1000;
inline constexpr size_t kMaxPictureBytes = size_t(64) << 20;

// {views: [{image: index into `images`, truth, rendered, error, depth, normal: data URI or null}], note}. `images` are
// the summary's. `note` says which views are shown when not all are; else it is empty.
Json Pictures(const WorkspaceState& state, const Json& images);

// The rendered view of median PSNR as a data URI; null when nothing was rendered.
Json MedianPicture(const WorkspaceState& state, const Json& images);

// How well the photos fix the estimated poses, as sfm's refinement.json says it; null where there is none.
// {n_points, n_observations, degeneracy, structure, reason, converged, remaining: standard deviations to the minimum,
//  iterations, error_px: {before, after: {median, mean}}, n_left_out: {points, behind, beyond_lens}: of observations
//  but the points, track_lengths: [{length, n}] ascending, components: [images of each], descending, cameras: [{name,
//  split, position: deviation over the distance to the scene's centre, rotation_deg}], weakest first, left_out: [{name,
//  reason}]: photos without a pose or a part in it}
// Throws CorruptError.
Json Certificate(const WorkspaceState& state);

// One workspace of a joint report.
struct Run {
  WorkspaceState state;
  Json summary;
};

// Runs of the same capture side by side: [{capture: its name, runs: [index into `runs`],
//  views: [{name, truth: data URI or null, shown: [{rendered, error: data URI or null, psnr}], one per run}]}], the
// worst, the median and the best by mean PSNR of the views that all of the capture's scored runs have.
Json Comparisons(const std::vector<Run>& runs);

// {points: {n, n_total, positions: Base64 of float32 x y z, colors: Base64 of uint8 r g b} | null,
//  cameras: [{name, split, scene_from_camera [16], slope_x, slope_y}]}: positions in scene units; slopes are half the
// field of view's tangents. Null when the pose stage has not run. Throws CorruptError when its files are damaged.
Json Geometry(const WorkspaceState& state);

// What ingest took of the capture's videos: [{name, n_frames, verdicts: {of kept, repeated, blurred, near: how many
// frames}, thumbnails: [{picture: data URI, seconds: into the video or null, verdict}]}]; null without videos. Throws
// CorruptError when ingest's videos.json is damaged.
Json VideoFrames(const WorkspaceState& state);

}  // namespace nrff
