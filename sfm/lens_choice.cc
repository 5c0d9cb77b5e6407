#include "sfm/lens_choice.h"

#include <Eigen/QR>
#include <algorithm>
#include <cmath>
#include <map>
#include <utility>

#include "sfm/distortion.h"
#include "sfm/lens_model.h"

namespace nrff {
namespace {

constexpr CameraModel kCandidates[] = {CameraModel::kRadial, CameraModel::kOpenCV, CameraModel::kOpenCVFisheye};
constexpr size_t kLongTrack = 4;        // three observations are left to place the point by
constexpr size_t kPointsPerImage = 60;  // of trials: more change no verdict and take longer
constexpr size_t kFewestPointsTried = 3000;
constexpr double kLeastGain = 0.1;  // of trials: more steps change no held-out error by a thousandth

// One of 0 … n − 1 for the number `i`, evenly.
size_t Pick(uint64_t i, size_t n) {
  uint64_t x = (i + 1) * 0x9e3779b97f4a7c15ULL;
  x = (x ^ (x >> 32)) * 0xd6e8feb86659fd93ULL;
  return size_t((x ^ (x >> 32)) % n);
}

struct HeldOut {
  uint64_t point;
  uint32_t image;
  Eigen::Vector2d px;
};

// Of the points with long tracks as many as are tried, without one observation each.
ColmapModel WithoutHeldOut(const ColmapModel& model, std::vector<HeldOut>& held_out) {
  std::vector<uint64_t> points;
  for (const auto& [id, point] : model.points) {
    if (point.track.size() >= kLongTrack) points.push_back(id);
  }
  const size_t n_tried = std::max(kFewestPointsTried, kPointsPerImage * model.images.size());
  std::sort(points.begin(), points.end(), [](uint64_t a, uint64_t b) {
    const auto key = [](uint64_t id) { return std::pair(Pick(id, size_t(1) << 30), id); };
    return key(a) < key(b);
  });
  if (points.size() > n_tried) points.resize(n_tried);
  ColmapModel fitted = model;
  fitted.points.clear();
  for (const uint64_t id : points) {
    ColmapPoint point = model.points.at(id);
    const size_t out = Pick(id, point.track.size());
    const auto [image, index] = point.track[out];
    const ColmapObservation& observation = model.images.at(image).observations[index];
    held_out.push_back({id, image, {observation.x, observation.y}});
    point.track.erase(point.track.begin() + std::ptrdiff_t(out));
    fitted.points.emplace(id, std::move(point));
  }
  for (auto& [id, image] : fitted.images) {
    for (ColmapObservation& observation : image.observations) observation.point_id = -1;
  }
  for (const auto& [id, point] : fitted.points) {
    for (const auto& [image, index] : point.track) fitted.images.at(image).observations[index].point_id = int64_t(id);
  }
  return fitted;
}

double HeldOutError_px(const ColmapModel& model, const std::vector<HeldOut>& held_out) {
  std::map<uint32_t, Lens> lenses;
  for (const auto& [id, camera] : model.cameras) lenses.emplace(id, camera);
  double sum = 0;
  for (const HeldOut& o : held_out) {
    const ColmapImage& image = model.images.at(o.image);
    const Eigen::Vector3d in_camera = image.rotation * model.points.at(o.point).position + image.translation;
    double error_px = kMostHeldOut_px;
    if (in_camera.z() > 0) {
      if (const auto px = lenses.at(image.camera_id).ImageFromCamera(in_camera.hnormalized()))
        error_px = std::min(error_px, (*px - o.px).norm());
    }
    sum += error_px;
  }
  return sum / double(held_out.size());
}

std::map<uint32_t, size_t> ImagesOfCameras(const ColmapModel& model) {
  std::map<uint32_t, size_t> n_images;
  for (const auto& [id, image] : model.images) ++n_images[image.camera_id];
  return n_images;
}

ColmapModel RefinedWithSharedCameras(const ColmapModel& model, double least_gain, int n_threads) {
  return RefineBundle(model, {.least_gain = least_gain, .principal_points = false, .n_threads = n_threads}).model;
}

// A camera for each image, of which the focal length alone is its own.
RefinedBundle RefinedWithOwnFocalLengths(ColmapModel model, const BundleOptions& options) {
  const std::map<uint32_t, ColmapCamera> shared = std::exchange(model.cameras, {});
  for (auto& [id, image] : model.images) {
    ColmapCamera& own = model.cameras[id] = shared.at(image.camera_id);
    own.id = image.camera_id = id;
  }
  return RefineBundle(model, options);
}

double Median(std::vector<double> values) {
  const auto middle = values.begin() + std::ptrdiff_t(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

// k1 to k4 of θ (1 + k1 θ² + …) for the radius that the lens gives rays at θ, by least squares up to its corners.
std::array<double, 4> FisheyeCoefficients(const ColmapCamera& camera) {
  const double* k = camera.params.data() + lens_model::FirstDistortion(camera.model);
  const double farthest = FieldOfView_deg(camera) / 2 * M_PI / 180;
  constexpr int kSamples = 64;
  Eigen::Matrix<double, kSamples, 4> powers;
  Eigen::Matrix<double, kSamples, 1> excess;
  for (int i = 0; i < kSamples; ++i) {
    const double theta = farthest * (i + 1) / kSamples;
    excess[i] = lens_model::Distort(camera.model, k, std::tan(theta), 0.0).u - theta;
    for (int j = 0; j < 4; ++j) powers(i, j) = std::pow(theta, 3 + 2 * j);
  }
  const Eigen::Vector4d fit = powers.colPivHouseholderQr().solve(excess);
  return {fit[0], fit[1], fit[2], fit[3]};
}

}  // namespace

double FieldOfView_deg(const ColmapCamera& camera) {
  const Lens lens(camera);
  double radius = 0;
  for (const double x : {0.0, double(camera.width)}) {
    for (const double y : {0.0, double(camera.height)}) {
      const auto uv = lens.CameraFromImage({x, y});
      radius = std::max(radius, uv ? uv->norm() : lens.ValidRadius());
    }
  }
  return 2 * std::atan(radius) * 180 / M_PI;
}

ColmapCamera WithCameraModel(const ColmapCamera& camera, CameraModel model) {
  ColmapCamera converted = camera;
  converted.model = model;
  if (model == camera.model) return converted;
  const auto first = size_t(lens_model::FirstDistortion(camera.model));
  const std::vector<double> distortion(camera.params.begin() + std::ptrdiff_t(first), camera.params.end());
  converted.params = {camera.params[0]};
  if (!lens_model::HasOneFocalLength(model)) converted.params.push_back(camera.params[first - 3]);
  converted.params.insert(converted.params.end(), {camera.params[first - 2], camera.params[first - 1]});
  if (model == CameraModel::kOpenCVFisheye) {
    const std::array<double, 4> k = FisheyeCoefficients(camera);
    converted.params.insert(converted.params.end(), k.begin(), k.end());
  } else {
    converted.params.insert(converted.params.end(), distortion.begin(), distortion.end());
    converted.params.resize(size_t(CameraModelParamCount(model)), 0.0);
  }
  return converted;
}

ColmapModel WithLenses(ColmapModel model, CameraModel camera_model) {
  for (const auto& [id, n_images] : ImagesOfCameras(model)) {
    ColmapCamera& camera = model.cameras.at(id);
    if (n_images >= kFewestForLens) camera = WithCameraModel(camera, camera_model);
  }
  return model;
}

namespace {

needs::FocalLengthErrors TriedOwnFocalLengths(const ColmapModel& fitted, const std::vector<HeldOut>& held_out,
                                              int n_threads) {
  const ColmapModel shared = RefinedWithSharedCameras(fitted, kLeastGain, n_threads);
  BundleOptions options = OwnFocalLengthsAlone(n_threads);
  options.least_gain = kLeastGain;
  const RefinedBundle own = RefinedWithOwnFocalLengths(shared, options);
  return {HeldOutError_px(shared, held_out), HeldOutError_px(own.model, held_out)};
}

}  // namespace

std::optional<needs::FocalLengthErrors> TryOwnFocalLengths(const ColmapModel& model, int n_threads) {
  std::vector<HeldOut> held_out;
  const ColmapModel fitted = WithoutHeldOut(model, held_out);
  if (held_out.size() < kFewestHeldOut || ImagesOfCameras(model).size() == model.images.size()) return {};
  return TriedOwnFocalLengths(fitted, held_out, n_threads);
}

RefinedBundle WithOwnFocalLengths(const ColmapModel& model, int n_threads) {
  const BundleOptions options = OwnFocalLengthsAlone(n_threads);
  RefinedBundle own =
      RefinedWithOwnFocalLengths(RefinedWithSharedCameras(model, options.least_gain, n_threads), options);
  if (!own.certificate.accepted) own.model = model;
  return own;
}

RefinedBundle WithOwnFocalLengths(ColmapModel mapped, const ColmapModel& shared, int n_threads) {
  std::map<uint32_t, std::vector<uint32_t>> images_of;  // by the shared camera
  for (const auto& [id, image] : mapped.images) {
    if (const auto before = shared.images.find(id); before != shared.images.end())
      images_of[before->second.camera_id].push_back(id);
  }
  for (const auto& [camera_id, images] : images_of) {
    ColmapCamera lens = shared.cameras.at(camera_id);
    const auto first = size_t(lens_model::FirstDistortion(lens.model));
    for (size_t i = first; i < lens.params.size(); ++i) {
      std::vector<double> values;
      for (const uint32_t id : images) values.push_back(mapped.cameras.at(mapped.images.at(id).camera_id).params[i]);
      lens.params[i] = Median(std::move(values));
    }
    for (const uint32_t id : images) {
      ColmapCamera& own = mapped.cameras.at(mapped.images.at(id).camera_id);
      std::copy(lens.params.begin() + std::ptrdiff_t(first) - 2, lens.params.end(),
                own.params.begin() + std::ptrdiff_t(first) - 2);
    }
  }
  return RefinedWithOwnFocalLengths(std::move(mapped), OwnFocalLengthsAlone(n_threads));
}

LensChoice ChooseLens(const ColmapModel& model, bool own_focal_lengths, int n_threads) {
  LensChoice choice;
  std::vector<HeldOut> held_out;
  const ColmapModel fitted = WithoutHeldOut(model, held_out);
  const std::map<uint32_t, size_t> n_images = ImagesOfCameras(model);
  if (held_out.size() < kFewestHeldOut ||
      std::none_of(n_images.begin(), n_images.end(), [](const auto& n) { return n.second >= kFewestForLens; }))
    return choice;
  const BundleOptions options{.least_gain = kLeastGain, .n_threads = n_threads};
  const auto attempt = [&](CameraModel camera_model) {
    const RefinedBundle refined = RefineBundle(WithLenses(fitted, camera_model), options);
    choice.trials.push_back({camera_model, HeldOutError_px(refined.model, held_out)});
    return choice.trials.back();
  };
  LensTrial best = attempt(CameraModel::kSimpleRadial);
  const bool wide = std::any_of(model.cameras.begin(), model.cameras.end(),
                                [](const auto& camera) { return FieldOfView_deg(camera.second) >= kWide_deg; });
  for (const CameraModel candidate : kCandidates) {
    if (candidate == CameraModel::kOpenCVFisheye && !wide) continue;
    const LensTrial trial = attempt(candidate);
    const Decision decision =
        needs::RicherLens(CameraModelName(best.model), best.error_px, CameraModelName(candidate), trial.error_px);
    if (!choice.decision || decision.needed || !choice.decision->needed) choice.decision = decision;
    if (decision.needed) best = trial;
  }
  choice.chosen = best.model;
  if (best.model != CameraModel::kSimpleRadial && own_focal_lengths && n_images.size() < model.images.size()) {
    const needs::FocalLengthErrors errors = TriedOwnFocalLengths(fitted, held_out, n_threads);
    if (needs::OwnFocalLengths(errors).needed) {
      choice.decision = needs::RicherLens(CameraModelName(CameraModel::kSimpleRadial), choice.trials.front().error_px,
                                          CameraModelName(best.model), best.error_px, errors.own_px);
      choice.zoomed = !choice.decision->needed;
      if (choice.zoomed) choice.chosen = CameraModel::kSimpleRadial;
    }
  }
  return choice;
}

}  // namespace nrff
