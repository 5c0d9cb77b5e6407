#include "pipeline/report_warnings.h"

#include <fmt/format.h>

#include <string>

namespace nrff {
namespace {

constexpr double kLowRegistration = 0.8;  // of the photos

int Count(const Json& facts, const char* key) {
  const Json& value = At(facts, key);
  return value.is_number() ? value.get<int>() : 0;
}

std::string Text(const Json& value) { return value.is_string() ? value.get<std::string>() : value.dump(); }

Json Strings(const Json& list) {
  Json strings = Json::array();
  for (const Json& item : list) strings.push_back(Text(item));
  return strings;
}

std::string Photos(size_t n) { return fmt::format("{} photo{}", n, n == 1 ? "" : "s"); }

void WarnOfRegistration(const Json& sfm, const Json& pose, const Json& ingest, Json& warnings) {
  const int n_images = Count(sfm, "n_images"), n_registered = Count(sfm, "n_registered");
  if (n_images > 0 && n_registered < kLowRegistration * n_images) {
    warnings.push_back({{"kind", "low registration"},
                        {"text", fmt::format("Only {} of {} photos could be placed. Scores are over a part of the "
                                             "capture; photos with more overlap would help.",
                                             n_registered, n_images)},
                        {"items", Json::array()}});
  }
  const int n_test = Count(ingest, "n_test");
  if (At(pose, "n_views_test").is_number() && Count(pose, "n_views_test") < n_test) {
    warnings.push_back(
        {{"kind", "held-out photos without a pose"},
         {"text", fmt::format("{} of {} held-out photos have no pose: the scores are means over the "
                              "other {}.",
                              n_test - Count(pose, "n_views_test"), n_test, Count(pose, "n_views_test"))},
         {"items", Json::array()}});
  }
  const Json& unregistered = At(pose, "unregistered").is_array() ? At(pose, "unregistered") : At(sfm, "unregistered");
  if (!unregistered.empty()) {
    warnings.push_back({{"kind", "unregistered photos"},
                        {"text", Photos(unregistered.size()) + " without a pose: not used for training or scores."},
                        {"items", Strings(unregistered)}});
  }
  const Json& groups = At(sfm, "groups");
  if (groups.size() > 1) {
    Json items = Json::array();
    for (const Json& group : groups) {
      items.push_back(fmt::format("{}, {} points: {}", Photos(size_t(Count(group, "n_images"))),
                                  Count(group, "n_points"), Text(At(group, "photos"))));
    }
    warnings.push_back({{"kind", "several groups"},
                        {"text", "The photos fall into groups, of which only the largest is shown here. " +
                                     Text(At(sfm, "groups_advice")) + "."},
                        {"items", items}});
  }
  constexpr double kPinholeField_deg = 120;  // undistortion keeps 60° to every side (sfm/undistort.h)
  if (const Json& field = At(sfm, "field_of_view_deg"); field.is_number() && field.get<double>() > kPinholeField_deg) {
    warnings.push_back({{"kind", "wide lens"},
                        {"text", fmt::format("The lens shows {:.0f}° between corners. Of that 60° to every side are "
                                             "learnt from and scored; what lies beyond is not used.",
                                             field.get<double>())},
                        {"items", Json::array()}});
  }
}

}  // namespace

Json Warnings(const WorkspaceState& state) {
  Json warnings = Json::array();
  const Json &ingest = state.Facts("ingest"), &eval = state.Facts("eval");
  for (const char* figure : {"psnr_reason", "ssim_reason"}) {
    const Json& reason = At(eval, figure);
    if (!reason.is_string()) continue;
    warnings.push_back({{"kind", "no score"},
                        {"text", fmt::format("No {}: {}.", figure[0] == 'p' ? "PSNR" : "SSIM", Text(reason))},
                        {"items", Json::array()}});
  }
  if (const int n_identical = Count(eval, "n_identical"); n_identical > 0) {
    warnings.push_back(
        {{"kind", "identical images"},
         {"text", fmt::format("{} rendered view{} identical to the photo: infinite PSNR, not in the mean.", n_identical,
                              n_identical == 1 ? " is" : "s are")},
         {"items", Json::array()}});
  }
  WarnOfRegistration(state.Facts("sfm"), state.Facts("pose"), ingest, warnings);

  const Json& rejected = At(ingest, "rejected");
  if (!rejected.empty()) {
    Json items = Json::array();
    for (const Json& photo : rejected) items.push_back(Text(At(photo, "name")) + ": " + Text(At(photo, "reason")));
    const std::string text = "Files that could not be used: " + std::to_string(rejected.size()) + ".";
    warnings.push_back({{"kind", "rejected photos"}, {"text", text}, {"items", items}});
  }
  const Json& duplicates = At(ingest, "duplicates");
  if (!duplicates.empty()) {
    Json items = Json::array();
    for (const Json& group : duplicates) {
      std::string names;
      for (const Json& name : group) names += (names.empty() ? "" : " = ") + Text(name);
      items.push_back(names);
    }
    warnings.push_back(
        {{"kind", "duplicates"},
         {"text", fmt::format("{} group{} of identical photos.", duplicates.size(), duplicates.size() == 1 ? "" : "s")},
         {"items", items}});
  }
  return warnings;
}

}  // namespace nrff
