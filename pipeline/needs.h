// What a scene does not need: pure functions from measured facts to decisions.
//
// Stages measure facts, ask here, act on the answer and record it in their manifest. A decision can be forced either
// way by an option of the stage; `reason` then says so.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "pipeline/json.h"

namespace nrff {

struct Decision {
  std::string feature;  // "sfm", "undistortion", "contraction", …
  bool needed = true;
  std::string evidence;   // the measured fact, with its unit
  std::string threshold;  // what the fact was compared with
  std::string reason;     // one clause: why this follows
};

// Overrides what was decided where `forced` says so; the reason then says that it was forced.
void Force(Decision& decision, std::optional<bool> forced);

void to_json(Json& json, const Decision& value);
void from_json(const Json& json, Decision& value);

namespace needs {

// SfM is left out when the capture brings poses.
Decision Sfm(bool poses_given, const std::string& where_from);

// Undistortion is left out when no pixel moves by 0.1 px or more.
Decision Undistortion(double largest_displacement_px);

// Contraction of unbounded space is left out when the capture gives a bounding box, is masked (alpha), or was declared
// bounded. `background_fraction` is the share of sparse points outside the box seen by the cameras; only a capture with
// a plain background has one, since sky and other smooth surroundings have no points.
Decision Contraction(bool box_given, bool has_alpha, std::optional<double> background_fraction);

// All pairs are matched when there are few; beyond that, neighbours in capture order (with loop closure) are enough if
// the capture is ordered.
Decision ExhaustiveMatching(int n_images, bool ordered);

// The finest grid resolution that training settles. Few views leave finer cells to be learnt by heart, view by view,
// unless sparse depths hold the surfaces in place. Measured on training views held out: without depths, eight views of
// sceaux_castle, 500 steps: 64 shows the ninth at 18.3 dB, 128 at 17.9, 256 at 16.4. With depths, 60 s on one core, 64
// → 256: castle 20.3 → 19.8 dB, kermit 14.9 → 16.4, ET 14.9 → 15.7. The bounds of 16 and 32 views are not measured.
int FinestResolution(int n_train_views, bool sparse_depth);

// Grid levels finer than FinestResolution are left out where the preset's `finest` is beyond it.
Decision FineLevels(int n_train_views, bool sparse_depth, int finest);

// Learning from the depths of sparse points is left out where there are hardly any, and in bounded scenes, whose
// silhouettes settle the geometry. Measured on training views held out, 60 s on one core, without → with: fox 26.0 →
// 27.1 dB, cup 25.3 → 26.3, sceaux_castle 17.4 → 20.5, kermit 13.2 → 15.5; bounded maryrose 21.0 → 20.8. One seed,
// while the preset was being tuned, with COLMAP's own points, before they were triangulated anew from training rays.
Decision SparseDepth(size_t n_depths, bool unbounded);

// LPIPS is left out when no network file is given.
Decision Lpips(const std::string& network_path);

// CUDA is left out when there is no usable GPU, or this version cannot train and render on one.
Decision Cuda(bool has_cuda_path, int n_gpus);

}  // namespace needs
}  // namespace nrff
