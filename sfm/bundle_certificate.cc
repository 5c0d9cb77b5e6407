#include <algorithm>
#include <cmath>

#include "pipeline/files.h"
#include "pipeline/log.h"
#include "sfm/bundle_refinement.h"
#include "sfm/capture.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

Json Numbers(const Eigen::Matrix3d& matrix) {
  Json numbers = Json::array();
  for (int i = 0; i < 9; ++i) numbers.push_back(matrix(i / 3, i % 3));
  return numbers;
}

}  // namespace

Json CertificateJson(const BundleCertificate& certificate, const ColmapModel& model) {
  constexpr size_t kMostNamed = 20, kWeakest = 5;
  const auto name = [&](uint32_t id) { return EscapePath(model.images.at(id).name); };
  const auto or_null = [](const auto& value) { return value ? Json(*value) : Json(); };
  Json components = Json::array();
  for (const BundleComponent& component : certificate.components) {
    Json names = Json::array();
    for (const uint32_t id : component.images) names.push_back(name(id));
    components.push_back({{"anchor", name(component.anchor)},
                          {"partner", name(component.partner)},
                          {"images", names},
                          {"n_points", component.n_points}});
  }
  std::vector<const PoseCovariance*> weakest;
  Json images = Json::array();
  for (const PoseCovariance& pose : certificate.covariances) {
    weakest.push_back(&pose);
    images.push_back({{"name", name(pose.image)},
                      {"position_deviation", pose.PositionDeviation()},
                      {"rotation_deviation_deg", pose.RotationDeviation() * 180 / M_PI},
                      {"position_covariance", Numbers(pose.position)},
                      {"rotation_covariance", Numbers(pose.rotation)}});
  }
  std::stable_sort(weakest.begin(), weakest.end(), [](const PoseCovariance* a, const PoseCovariance* b) {
    return a->PositionDeviation() > b->PositionDeviation();
  });
  Json weakest_names = Json::array();
  for (size_t i = 0; i < std::min(kWeakest, weakest.size()); ++i) weakest_names.push_back(name(weakest[i]->image));
  Json images_left_out = Json::array(), track_lengths = Json::object();
  for (const std::string& image : certificate.images_left_out) images_left_out.push_back(EscapePath(image));
  for (size_t n = 0; n < certificate.track_lengths.size(); ++n) {
    if (certificate.track_lengths[n] > 0) track_lengths[std::to_string(n)] = certificate.track_lengths[n];
  }
  std::vector<uint64_t> points_left_out = certificate.points_left_out;
  points_left_out.resize(std::min(points_left_out.size(), kMostNamed));
  const auto errors = [](const ReprojectionErrors& e) { return Json{{"median", e.median_px}, {"mean", e.mean_px}}; };
  return {{"schema_version", 1},
          {"accepted", certificate.accepted},
          {"reason", certificate.accepted ? Json() : Json(certificate.reason)},
          {"degeneracy", or_null(certificate.degeneracy)},
          {"structure", certificate.structure},
          {"n_points", certificate.n_points},
          {"n_observations", certificate.n_observations},
          {"left_out",
           {{"images", images_left_out},
            {"n_points", certificate.points_left_out.size()},
            {"points", points_left_out},
            {"n_observations_behind", certificate.n_behind},
            {"n_observations_beyond_lens", certificate.n_beyond_lens}}},
          {"components", components},
          {"track_lengths", track_lengths},
          {"held", certificate.held},
          {"n_principal_points_held", certificate.n_principal_held},
          {"reprojection_error_px", {{"before", errors(certificate.before)}, {"after", errors(certificate.after)}}},
          {"cost_px2", {{"before", certificate.cost_before}, {"after", certificate.cost_after}}},
          {"n_behind_after", certificate.n_behind_after},
          {"n_beyond_lens_after", certificate.n_beyond_lens_after},
          {"iterations", certificate.iterations},
          {"seconds", certificate.seconds},
          {"solver", certificate.solver},
          {"converged", certificate.converged},
          {"gradient_norm", certificate.gradient_norm},
          {"remaining_deviations", or_null(certificate.remaining)},
          {"deviation_px", certificate.deviation_px},
          {"images", images},
          {"weakest_images", weakest_names}};
}

fs::path FolderOfModel(const fs::path& dir) {
  const fs::path inside = dir / kGivenModelDir;
  return fs::is_directory(inside) ? inside : dir;
}

void RefineModel(const fs::path& dir, const BundleOptions& options, ArtifactWriter& artifact) {
  const ColmapModel model = ReadColmapModel(dir);
  const auto [refined, certificate] = RefineBundle(model, options);
  fs::create_directories(artifact.dir() / kGivenModelDir);
  WriteColmapBinary(refined, artifact.dir() / kGivenModelDir);
  WriteJson(artifact.dir() / kRefinementName, CertificateJson(certificate, model));
  artifact.AddOutput(kGivenModelDir);
  artifact.facts() = {{"accepted", certificate.accepted}, {"iterations", certificate.iterations}};
  if (!certificate.accepted)
    LogWarning("the model is as it was: " + certificate.reason);
  else if (certificate.degeneracy)
    LogWarning(*certificate.degeneracy);
  if (certificate.accepted && !certificate.converged) {
    LogWarning("not at the minimum after " + std::to_string(certificate.iterations) + " iterations");
  }
  char errors[64];
  std::snprintf(errors, sizeof errors, "%.3f px, before %.3f px", certificate.after.median_px,
                certificate.before.median_px);
  LogInfo("median reprojection error " + std::string(errors));
}

}  // namespace nrff
