#include "pipeline/extension.h"

#include <algorithm>
#include <cstdio>

#include "pipeline/files.h"

namespace nrff {
namespace {

// Mean reprojection error that a merged model may have: added photos may be worse than the earlier ones, not by much.
constexpr double kMostErrorRatio = 1.25, kErrorRoom_px = 0.1;

constexpr double kMostCentreShift = 0.5, kMostScaleRatio = 1.5;
constexpr double kMostOutside = 0.05;  // robust boxes leave out up to 3 % by themselves

constexpr double kLeastShare = 0.25;

std::string Number(const char* format, double value) {
  char text[32];
  std::snprintf(text, sizeof text, format, value);
  return text;
}

std::string Of(size_t n, size_t all) { return std::to_string(n) + " of " + std::to_string(all); }

}  // namespace

HashedPath BaseInput(const std::filesystem::path& dir) {
  std::filesystem::path path = std::filesystem::absolute(dir).lexically_normal();
  if (!path.has_filename()) path = path.parent_path();
  // By its place in the workspace: one that is moved stays fresh.
  return {EscapePath(std::filesystem::path(kBaseFolder) / path.filename()), HashTree(path), 0};
}

namespace needs {

bool SameWorld(const MergedModel& model) {
  return model.n_lost == 0 && model.shift_px && *model.shift_px <= kMostShift_px &&
         model.error_px <= kMostErrorRatio * model.error_before_px + kErrorRoom_px;
}

Decision PosesAnew(const MergedModel& model, bool mapped_anew) {
  Decision decision{"poses_anew", mapped_anew, "", "all photos placed, the earlier ones where they were", ""};
  decision.evidence = Of(model.n_added_placed, model.n_added) + " added photos placed";
  if (model.n_lost > 0) decision.evidence += ", " + std::to_string(model.n_lost) + " earlier ones lost";
  decision.evidence +=
      ", mean error " + Number("%.2f px", model.error_px) + " after " + Number("%.2f px", model.error_before_px);
  if (model.shift_px) decision.evidence += ", earlier points moved by " + Number("%.2f px", *model.shift_px);
  decision.reason = mapped_anew
                        ? "mapping from scratch places more photos, or places them better, than the earlier model grown"
                        : "added photos were placed in the model of " + std::to_string(model.n_earlier_placed) +
                              " earlier ones, whose features and matches are kept";
  return decision;
}

Decision FrameAnew(bool same_kind, bool unbounded, double centre_shift, double scale_ratio, double outside) {
  Decision decision{"frame_anew", false, "", "", "coordinates of the earlier scene stay valid"};
  if (!same_kind) {
    decision.needed = true;
    decision.evidence = std::string("the scene is ") + (unbounded ? "unbounded" : "bounded") + " now";
    decision.threshold = "as before";
    decision.reason = "the earlier box means something else";
    return decision;
  }
  if (unbounded) {
    decision.evidence = "the foreground's centre would move by " + Number("%.2f", centre_shift) +
                        " of its half-extent, its size change by a factor of " + Number("%.2f", scale_ratio);
    decision.threshold = Number("%g", kMostCentreShift) + ", a factor of " + Number("%g", kMostScaleRatio);
    decision.needed = !(centre_shift <= kMostCentreShift && std::max(scale_ratio, 1 / scale_ratio) <= kMostScaleRatio);
  } else {
    decision.evidence = Number("%.1f %%", 100 * outside) + " of the points lie outside the earlier box";
    decision.threshold = Number("%g %%", 100 * kMostOutside);
    decision.needed = !(outside <= kMostOutside);
  }
  if (decision.needed) decision.reason = "the added photos show another part of the world";
  return decision;
}

Decision TrainingAnew(const std::string& why, double share) {
  Decision decision{"training_anew", !why.empty(), "", "the same field in the same frame", why};
  if (why.empty()) {
    decision.evidence = "the earlier model is of the same kind and in the same frame";
    decision.reason = "training goes on from it for " + Number("%.0f %%", 100 * share) + " of the steps or the time";
  } else {
    decision.evidence = "there is an earlier model";
  }
  return decision;
}

double TrainingShare(size_t n_views, size_t n_added) {
  return n_views == 0 ? 1 : std::clamp(double(n_added) / double(n_views), kLeastShare, 1.);
}

}  // namespace needs
}  // namespace nrff
