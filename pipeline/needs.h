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

// All pairs are matched when there are few. Beyond that each photo is matched with those most like it at a first look
// (sfm/first_look.h) and, in a capture in the order of taking, with its next ones, so that pairs grow linearly with
// photos: ten alike hold 97 % and more of each photo's five best partners (tests/bench/results/first_look.md).
Decision ExhaustiveMatching(int n_images, bool ordered);

// Pairs of photos taken near each other are matched, too, where not all are, all photos say where they were taken, and
// the places lie further apart (root mean square from their mean) than satellites' errors of some 5 m can make it seem.
Decision GpsPairs(bool all_pairs, std::optional<double> spread_m);

// A second attempt at poses, with larger photos and more features, is made where less than 80 % of the photos could be
// placed; but not where they fell into groups that together take in so many and no pair of photos holds two of these
// together: as two captures in one folder do (fox and maryrose, tests/bench/results/hard_captures.md). Groups of one
// scene that hardly overlap end so, too; photos in between, which the user is told to add, join them more surely.
inline constexpr double kEnoughPlaced = 0.8;
Decision SecondAttempt(int n_images, int n_registered, int n_groups, int n_in_groups, int n_holding_pairs);

// A camera model with more parameters is taken only where it predicts observations that neither was fitted to better by
// 3 %. Of a made lens with a moustache it is 3.1 % (OPENCV; reprojection errors 0.37 → 0.31 px, positions off by 0.0017
// → 0.0010 units, but rotations by 0.12 → 0.34°, since the principal point is fitted, too), of fox 3.2 % (RADIAL); of
// lenses that the simpler model is true of less than 1.5 % (tests/lens_choice_test.cc), as of maryrose (0.1 %) and cup.
// Nor is it taken where the simpler one with a focal length for each photo does as well (`own_focal_px`; none where
// that was not tried): of zoomed photos a richer lens explains a part, which then turned cameras by 10° (OPENCV, 28 to
// 50 mm).
Decision RicherLens(const std::string& model, double error_px, const std::string& richer, double richer_error_px,
                    std::optional<double> own_focal_px = {});

// A focal length for each photo takes the place of shared ones only where it predicts observations held out of the fit
// better by 3 %. Of cup_simple_pinhole, whose given focal lengths differ by a tenth, it was 3.9 to 4.5 % in several
// runs (one model's poses were off by 1.12 → 0.49° and 19 → 12 ‰ from the given ones; held-out PSNR did not change,
// tests/bench/results/facilities.md); of maryrose 2.0 to 2.7 % and fox −0.02 to 0.7 %, whose cameras came off by 6 and
// 1.4 times as far with it.
struct FocalLengthErrors {
  double shared_px = 0, own_px = 0;  // mean distances of held-out observations
};
Decision OwnFocalLengths(const FocalLengthErrors& errors);
// Where nothing was held out to tell by, because of `why`: not needed, or, where photos were added, `as_before`.
Decision OwnFocalLengthsUntried(const std::string& why, bool as_before = false);

// Poses, lenses and points are refined together at the end (sfm/bundle_refinement.h, by a robust loss until it
// converges) unless there are so many photos that it is not checked how well they fix the result. Maryrose's cameras
// came 6 % nearer to the given ones and fox's 7 %, for a tenth of mapping's time.
Decision Refinement(size_t n_images, size_t most);

// Photos that may be a fisheye's are mapped as such, too, from the same matches; it is one where no fewer photos are
// placed and a tenth more observations agree. EXIF cannot tell: 15 mm are a fisheye's 160° as well as a telephone's
// corrected 110°. A made fisheye's poses were 45 times and a 120° barrel's 6 times as far off with a simple lens, which
// placed all photos, too (tests/bench/results/hard_captures.md).
Decision Fisheye(int n_placed, size_t n_observations, int n_placed_as_fisheye, size_t n_observations_as_fisheye);

// The finest grid resolution that training settles. Few views leave finer cells to be learnt by heart, view by view,
// unless sparse depths hold the surfaces in place (tests/bench/results/features.md): without depths, fine levels cost
// sceaux_castle 0.1 dB and ET 0.9, gain kermit 0.2; with depths they gain all three, 0.1 to 0.9. The bounds of 16 and
// 32 views are not measured.
int FinestResolution(int n_train_views, bool sparse_depth);

// Grid levels finer than FinestResolution are left out where the preset's `finest` is beyond it.
Decision FineLevels(int n_train_views, bool sparse_depth, int finest);

// Learning from the depths of sparse points is left out where there are hardly any, and in bounded scenes, whose
// silhouettes settle the geometry. On training views held out they gain 0.6 to 5.1 dB in unbounded scenes
// (tests/bench/results/features.md); in bounded maryrose 0.4 after 800 steps but −0.2 after 60 s.
Decision SparseDepth(size_t n_depths, bool unbounded);

// Colour corrections of training views are left out where exposure and white balance hardly differ between them
// (`spread_ev`: ExposureSpread of scene.h), and in bounded scenes, where an object that was turned before its light
// looks as if exposures differed. Held-out PSNR (tests/bench/results/facilities.md): a made capture that drifts over
// 2 EV (a spread of 0.8) gains 0.5 dB, and 1.5 with fitted colours; in the mean of three seeds ET, at 0.5 EV,
// gains 1.7, and kermit, at 0.15, loses 1 with seeds 1.5 dB apart.
Decision ExposureCorrection(double spread_ev, bool unbounded);

// Corrections of the training views' cameras are left out where, looked at when a seventh of the training is done, they
// would move the pictures by less than kVisibleDisplacement_px in the median of the views (`displacement_px`; none
// where nobody looked), or than `least_px` where training was told otherwise. That is what the young model itself is
// wrong by: 0.3 px on lego with exact poses, where forced corrections cost 0.1 dB, 0.4 to 0.6 on fox, 0.1 dB; on lego
// with poses wrong by two pixels they see 0.9 and gain 2.1 (tests/bench/results/facilities.md).
inline constexpr double kVisibleDisplacement_px = 0.8;
Decision CameraCorrection(std::optional<double> displacement_px, double least_px);

// The model `small` is left out for `tiny` where so few of its steps fit in the training budget that the smaller model
// shows more. On training views held out, two cores with AMX (tests/bench/results/presets.md): lego at 200 px 22.4
// against 26.8 dB after 257 steps of `small`, 27.9 against 27.0 after 657; fox at 384 px (unbounded) 25.3 against 25.7
// after 659, 26.9 against 26.4 after 1365. Without AMX `tiny` gets more steps for each of `small`: on an AMD EPYC
// lego 27.6 against 28.6 after 650, fox 26.4 against 27.2 after 2240, 28.7 against 28.1 after 4900. A model with twice
// the width and a third more levels shows less yet after 2 min (lego, 35.9 against 36.1 dB).
Decision SmallModel(double steps_per_second, double budget_seconds, bool unbounded);

// LPIPS is left out when this word is given instead of a network file.
inline constexpr char kNoLpips[] = "none";
Decision Lpips(const std::string& network_path);

// CUDA is left out when there is no GPU that can be used, or the CPU was asked for. `what`: the GPU, or why there is
// none.
Decision Cuda(bool usable, const std::string& what);

}  // namespace needs
}  // namespace nrff
