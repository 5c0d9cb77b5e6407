#include "pipeline/needs.h"

#include <cstdio>

namespace nrff {

void Force(Decision& decision, std::optional<bool> forced) {
  if (!forced) return;
  decision.needed = *forced;
  decision.reason = "forced by an option";
}

void to_json(Json& json, const Decision& value) {
  json = {{"feature", value.feature},
          {"needed", value.needed},
          {"evidence", value.evidence},
          {"threshold", value.threshold},
          {"reason", value.reason}};
}

void from_json(const Json& json, Decision& value) {
  json.at("feature").get_to(value.feature);
  json.at("needed").get_to(value.needed);
  json.at("evidence").get_to(value.evidence);
  json.at("threshold").get_to(value.threshold);
  json.at("reason").get_to(value.reason);
}

namespace needs {
namespace {

std::string Format(const char* format, double value) {
  char text[96];
  std::snprintf(text, sizeof text, format, value);
  return text;
}

}  // namespace

Decision Sfm(bool poses_given, const std::string& where_from) {
  return {"sfm", !poses_given, poses_given ? "poses given by " + where_from : "no poses in " + where_from,
          "poses given",
          poses_given ? "the capture brings its camera poses" : "camera poses have to be estimated from the photos"};
}

Decision Undistortion(double largest_displacement_px) {
  const bool needed = largest_displacement_px >= 0.1;
  return {"undistortion", needed, Format("largest displacement %.3g px", largest_displacement_px), "0.1 px",
          needed ? "straight rays would miss their pixels" : "the lens moves no pixel visibly"};
}

Decision Contraction(bool box_given, bool has_alpha, std::optional<double> background_fraction) {
  Decision decision{"contraction", true, "", "a box, an alpha channel, or < 2 % of the points outside the box", ""};
  if (box_given) {
    decision.needed = false;
    decision.evidence = "bounding box given";
    decision.reason = "everything there is to see is inside the box";
  } else if (has_alpha) {
    decision.needed = false;
    decision.evidence = "alpha channel";
    decision.reason = "the background is masked out";
  } else {
    decision.needed = !background_fraction || *background_fraction >= 0.02;
    decision.evidence = background_fraction
                            ? Format("%.1f %% of the sparse points lie outside the box", *background_fraction * 100)
                            : "no box, no alpha channel, no plain background with points before it";
    decision.reason =
        decision.needed ? "the photos show surroundings that need a place" : "the photos show nothing but the object";
  }
  return decision;
}

Decision ExhaustiveMatching(int n_images, bool ordered) {
  // 32 images have 496 pairs, about as many as are chosen for fifty.
  const bool needed = n_images <= 32;
  return {"exhaustive_matching", needed,
          std::to_string(n_images) + (ordered ? " photos in capture order" : " photos in no known order"), "32 photos",
          needed    ? "all pairs of so few are cheap"
          : ordered ? "neighbours in capture order and photos alike at a first look overlap"
                    : "photos alike at a first look overlap"};
}

Decision GpsPairs(bool all_pairs, std::optional<double> spread_m) {
  if (all_pairs) return {"gps_pairs", false, "all pairs are matched", "20 m", "theirs are among them"};
  const bool needed = spread_m && *spread_m >= 20;
  return {"gps_pairs", needed,
          spread_m ? Format("photos taken %.1f m from their mean position", *spread_m)
                   : "not all photos say where they were taken",
          "20 m",
          needed      ? "photos taken near each other overlap"
          : !spread_m ? "without positions photos alike have to do"
                      : "the positions' errors are as large as their differences"};
}

Decision SecondAttempt(int n_images, int n_registered, int n_groups, int n_in_groups, int n_holding_pairs) {
  const auto enough = [&](int n) { return n >= kEnoughPlaced * n_images; };
  const bool apart = n_groups > 1 && n_holding_pairs == 0 && enough(n_in_groups);
  Decision decision{"second_attempt", !enough(n_registered) && !apart,
                    std::to_string(n_registered) + " of " + std::to_string(n_images) + " photos placed", "80 %", ""};
  if (n_groups > 1) {
    decision.evidence += ", " + std::to_string(n_in_groups) + " in " + std::to_string(n_groups) + " groups with " +
                         std::to_string(n_holding_pairs) + " pairs that hold between them";
    decision.threshold += ", or 80 % in groups without such pairs";
  }
  decision.reason = decision.needed        ? "more pixels and features may place more"
                    : enough(n_registered) ? "enough are placed"
                                           : "the groups are sound and share nothing: they show different things";
  return decision;
}

Decision RicherLens(const std::string& model, double error_px, const std::string& richer, double richer_error_px,
                    std::optional<double> own_focal_px) {
  const bool better = richer_error_px <= 0.97 * error_px, zoomed = own_focal_px && *own_focal_px <= richer_error_px;
  Decision decision{"richer_lens", better && !zoomed,
                    Format("observations held out are %.4f px off with ", error_px) + model +
                        Format(", %.4f with ", richer_error_px) + richer,
                    "3 % less", ""};
  if (own_focal_px) decision.evidence += Format(", %.4f with a photo's own focal length", *own_focal_px);
  decision.reason = !better  ? model + " describes the lens as well as " + richer
                    : zoomed ? "a lens that was zoomed describes the photos better"
                             : richer + " describes the lens better";
  return decision;
}

namespace {
constexpr char kOwnFocalLengths[] = "own_focal_lengths", kFocalLengthGain[] = "3 % and 0.01 px less";
}

Decision OwnFocalLengths(const FocalLengthErrors& errors) {
  constexpr double kVisible_px = 0.01;  // no feature is placed better
  const bool needed = errors.own_px <= 0.97 * errors.shared_px && errors.shared_px - errors.own_px >= kVisible_px;
  return {kOwnFocalLengths, needed,
          Format("observations held out are %.4f px off with shared focal lengths", errors.shared_px) +
              Format(", %.4f with a photo's own", errors.own_px),
          kFocalLengthGain,
          needed ? "the lens was zoomed or focused anew" : "one focal length describes the photos as well"};
}

Decision OwnFocalLengthsUntried(const std::string& why, bool as_before) {
  return {kOwnFocalLengths, as_before, why, kFocalLengthGain,
          as_before ? "the earlier photos were given their own" : "nothing was measured that asks for them"};
}

Decision Refinement(size_t n_images, size_t most) {
  const bool needed = n_images <= most;
  return {"refinement", needed, std::to_string(n_images) + " photos placed", std::to_string(most) + " at the most",
          needed ? "COLMAP's last adjustment ends before its minimum" : "its result could not be checked"};
}

Decision Fisheye(int n_placed, size_t n_observations, int n_placed_as_fisheye, size_t n_observations_as_fisheye) {
  const bool needed = n_placed_as_fisheye > 0 && n_placed_as_fisheye >= n_placed &&
                      double(n_observations_as_fisheye) >= 1.1 * double(n_observations);
  return {"fisheye", needed,
          std::to_string(n_placed_as_fisheye) + " photos with " + std::to_string(n_observations_as_fisheye) +
              " observations placed as a fisheye's, " + std::to_string(n_placed) + " with " +
              std::to_string(n_observations) + " as a simple lens's",
          "as many photos and 10 % more observations",
          needed ? "a fisheye explains more of what was matched" : "a fisheye explains no more of what was matched"};
}

int FinestResolution(int n_train_views, bool sparse_depth) {
  if (sparse_depth || n_train_views >= 32) return 256;
  return n_train_views < 16 ? 64 : 128;
}

Decision FineLevels(int n_train_views, bool sparse_depth, int finest) {
  const int wanted = FinestResolution(n_train_views, sparse_depth);
  const bool needed = finest <= wanted;
  return {"fine_levels", needed,
          std::to_string(n_train_views) + " training views " + (sparse_depth ? "with" : "without") +
              " sparse depths, finest level " + std::to_string(finest),
          "finest level " + std::to_string(wanted) + " for these",
          !needed        ? "finer levels would learn each view by heart"
          : sparse_depth ? "sparse depths hold the surfaces in place"
                         : "so many views settle every level"};
}

Decision SparseDepth(size_t n_depths, bool unbounded) {
  constexpr size_t kFewestDepths = 200;
  const bool needed = unbounded && n_depths >= kFewestDepths;
  return {"sparse_depth", needed,
          std::to_string(n_depths) + " depths, " + (unbounded ? "unbounded scene" : "bounded scene"),
          std::to_string(kFewestDepths) + " depths in an unbounded scene",
          needed       ? "sparse points tell where surfaces are"
          : !unbounded ? "silhouettes tell where surfaces are"
                       : "too few points to tell where surfaces are"};
}

Decision ExposureCorrection(double spread_ev, bool unbounded) {
  constexpr double kVisible_ev = 0.2;
  const bool differ = spread_ev >= kVisible_ev, needed = differ && unbounded;
  return {"exposure_correction", needed,
          Format("exposures of training views differ by %.3g EV", spread_ev) +
              (unbounded ? ", unbounded scene" : ", bounded scene"),
          "0.2 EV in an unbounded scene",
          needed   ? "one colour of a point cannot fit all photos"
          : differ ? "an object turned before its light changes its colours, too"
                   : "the photos agree, or have neither points nor EXIF to tell by"};
}

Decision CameraCorrection(std::optional<double> displacement_px, double least_px) {
  const bool needed = displacement_px && *displacement_px >= least_px;
  return {"camera_correction", needed,
          displacement_px ? Format("corrected cameras would move pictures by %.2f px", *displacement_px)
                          : "the preset looks at no cameras",
          Format("%.1f px in the median of the training views", least_px),
          needed            ? "photos and model disagree about where the cameras are"
          : displacement_px ? "the poses are as good as the young model can tell"
                            : "it keeps the poses as they are"};
}

Decision SmallModel(double steps_per_second, double budget_seconds, bool unbounded) {
  const auto steps = static_cast<int64_t>(steps_per_second * budget_seconds);
  const int64_t fewest = unbounded ? 1500 : 700;
  const bool needed = steps >= fewest;
  return {"small_model", needed,
          std::to_string(steps) + " steps of the preset small fit in " +
              std::to_string(static_cast<int64_t>(budget_seconds)) + " s",
          std::to_string(fewest) + " steps in " + (unbounded ? "an unbounded" : "a bounded") + " scene",
          needed ? "it has the time to show more than tiny" : "tiny shows more in this time"};
}

Decision Lpips(const std::string& network_path) {
  const bool given = network_path != kNoLpips;
  return {"lpips", given, given ? "network " + network_path : "no network file", "a network file",
          given ? "the network is there"
                : "LPIPS is defined by the weights of its network; make its file with eval/export_lpips.py where they "
                  "can be fetched, and give it with --lpips"};
}

Decision Cuda(bool usable, const std::string& what) {
  return {"cuda", usable, what, "a GPU that can be used", usable ? "the GPU is faster" : "the CPU does the work"};
}

}  // namespace needs
}  // namespace nrff
