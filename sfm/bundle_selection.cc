// What of a COLMAP model a bundle refinement takes, and the frames it is refined in.

#include <algorithm>
#include <cmath>
#include <map>
#include <numeric>
#include <set>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "sfm/bundle_problem.h"
#include "sfm/distortion.h"

namespace nrff {
namespace {

using Eigen::Vector2d;
using Eigen::Vector3d;

constexpr size_t kFewestPoints = 3;  // that fix a pose, if several ways
// Images of a camera from which on its principal point is free. Of fewer it is known by their deviations, too, but
// moves with their rotations and takes up whatever the lens model lacks: degrees on real captures.
constexpr size_t kFewestForPrincipal = 5;

[[noreturn]] void Refuse(const std::string& what) {
  throw InputError(what + "; a refinement needs finite numbers: export the model again");
}

void RequireFinite(const ColmapModel& model) {
  for (const auto& [id, image] : model.images) {
    const std::string name = "image " + EscapePath(image.name);
    const double norm = image.rotation.norm();
    if (!(norm > 1e-6) || !std::isfinite(norm) || !image.translation.allFinite()) {
      Refuse("The pose of " + name + " is not a finite rotation and translation");
    }
    if (!model.cameras.contains(image.camera_id)) Refuse("The camera of " + name + " is missing");
    for (size_t i = 0; i < image.observations.size(); ++i) {
      if (!std::isfinite(image.observations[i].x) || !std::isfinite(image.observations[i].y)) {
        Refuse("Observation " + std::to_string(i) + " of " + name + " is not finite");
      }
    }
  }
  for (const auto& [id, point] : model.points) {
    const std::string name = "point " + std::to_string(id);
    if (!point.position.allFinite()) Refuse("The position of " + name + " is not finite");
    for (const auto& [image_id, index] : point.track) {
      const auto image = model.images.find(image_id);
      if (image == model.images.end() || index >= image->second.observations.size()) {
        Refuse("The track of " + name + " names observation " + std::to_string(index) + " of image " +
               std::to_string(image_id) + ", which is not there");
      }
    }
  }
}

struct Candidate {
  uint64_t point = 0;
  uint32_t image = 0;
  Vector2d px;
};

// Observations of points in front of their camera, where its lens is one-to-one; by point.
std::vector<Candidate> VisibleObservations(const ColmapModel& model, BundleCertificate& certificate) {
  std::map<uint32_t, double> valid_radius;
  for (const auto& [id, camera] : model.cameras) valid_radius[id] = Lens(camera).ValidRadius();
  std::vector<Candidate> visible;
  for (const auto& [point_id, point] : model.points) {
    for (const auto& [image_id, index] : point.track) {
      const ColmapImage& image = model.images.at(image_id);
      const Vector3d in_camera = image.rotation.normalized() * (point.position - image.Center());
      if (!(in_camera.z() > 0)) {
        ++certificate.n_behind;
      } else if (!(in_camera.hnormalized().norm() < valid_radius.at(image.camera_id))) {
        ++certificate.n_beyond_lens;
      } else {
        visible.push_back({point_id, image_id, {image.observations[index].x, image.observations[index].y}});
      }
    }
  }
  return visible;
}

// Without points that fewer than two images see and images that see too few points, until none is left.
void KeepTied(std::vector<Candidate>& candidates) {
  for (size_t before = 0; before != candidates.size();) {
    before = candidates.size();
    std::map<uint64_t, std::set<uint32_t>> images_of_point;
    std::map<uint32_t, std::set<uint64_t>> points_of_image;
    for (const Candidate& c : candidates) {
      images_of_point[c.point].insert(c.image);
      points_of_image[c.image].insert(c.point);
    }
    std::erase_if(candidates, [&](const Candidate& c) {
      return images_of_point[c.point].size() < 2 || points_of_image[c.image].size() < kFewestPoints;
    });
  }
}

// Numbers images by what they are connected to through points, in order of their first image.
void FindComponents(Bundle& bundle) {
  std::vector<size_t> parent(bundle.images.size());
  std::iota(parent.begin(), parent.end(), size_t(0));
  const auto root = [&parent](size_t i) {
    while (parent[i] != i) i = parent[i] = parent[parent[i]];
    return i;
  };
  std::vector<size_t> first(bundle.points.size(), SIZE_MAX);
  for (const Bundle::Observation& o : bundle.observations) {
    if (first[o.point] == SIZE_MAX) first[o.point] = o.image;
    const size_t a = root(first[o.point]), b = root(o.image);
    parent[std::max(a, b)] = std::min(a, b);
  }
  std::map<size_t, size_t> number;
  for (size_t i = 0; i < bundle.images.size(); ++i) {
    bundle.images[i].component = number.emplace(root(i), number.size()).first->second;
  }
  for (size_t i = 0; i < bundle.points.size(); ++i) bundle.points[i].component = bundle.images[first[i]].component;
  bundle.components.resize(number.size());
}

void ChooseFrames(const ColmapModel& model, Bundle& bundle, BundleCertificate& certificate) {
  std::vector<size_t> n_observations(bundle.images.size());
  for (const Bundle::Observation& o : bundle.observations) ++n_observations[o.image];
  const auto center = [&](size_t i) { return model.images.at(bundle.images[i].id).Center(); };
  for (size_t c = 0; c < bundle.components.size(); ++c) {
    Bundle::Component& component = bundle.components[c];
    BundleComponent& described = certificate.components.emplace_back();
    std::vector<size_t> members;
    for (size_t i = 0; i < bundle.images.size(); ++i) {
      if (bundle.images[i].component != c) continue;
      members.push_back(i);
      described.images.push_back(bundle.images[i].id);
    }
    component.anchor = component.partner = *std::max_element(
        members.begin(), members.end(), [&](size_t a, size_t b) { return n_observations[a] < n_observations[b]; });
    component.origin = center(component.anchor);
    component.rotation = model.images.at(bundle.images[component.anchor].id).rotation.normalized().conjugate();
    double baseline = 0, rounding = 0;
    for (const size_t i : members) {
      const double distance = (center(i) - component.origin).norm();
      if (distance > baseline) baseline = distance, component.partner = i;
      rounding = std::max(rounding, 64 * std::numeric_limits<double>::epsilon() * center(i).norm());
    }
    component.unit = baseline;
    described.anchor = bundle.images[component.anchor].id;
    described.partner = bundle.images[component.partner].id;
    if (baseline > rounding) continue;
    certificate.degeneracy = "rotation only: all " + std::to_string(members.size()) + " images that are connected to " +
                             EscapePath(model.images.at(described.anchor).name) +
                             " are at one place, so that no baseline fixes the points' distances";
    return;
  }
  for (const Bundle::Point& point : bundle.points) ++certificate.components[point.component].n_points;
}

void FillValues(const ColmapModel& model, Bundle& bundle) {
  size_t size = bundle.ImageOffset(bundle.images.size());
  for (Bundle::Camera& camera : bundle.cameras) {
    camera.offset = size;
    size += camera.n_params;
  }
  bundle.values.resize(size);
  const auto in_frame = [&](size_t c, const Vector3d& world) -> Vector3d {
    const Bundle::Component& frame = bundle.components[c];
    return frame.rotation.conjugate() * (world - frame.origin) / frame.unit;
  };
  for (size_t i = 0; i < bundle.points.size(); ++i) {
    bundle.Position(i) = in_frame(bundle.points[i].component, model.points.at(bundle.points[i].id).position);
  }
  for (size_t i = 0; i < bundle.images.size(); ++i) {
    const size_t c = bundle.images[i].component;
    const ColmapImage& image = model.images.at(bundle.images[i].id);
    bundle.Rotation(i) = bundle.IsAnchor(i) ? Eigen::Quaterniond::Identity()
                                            : (image.rotation * bundle.components[c].rotation).normalized();
    bundle.Center(i) = bundle.IsAnchor(i) ? Vector3d(0, 0, 0) : in_frame(c, image.Center());
  }
  for (size_t i = 0; i < bundle.cameras.size(); ++i) {
    const std::vector<double>& params = model.cameras.at(bundle.cameras[i].id).params;
    std::copy(params.begin(), params.end(), bundle.Intrinsics(i));
  }
  for (Bundle::Component& component : bundle.components) {
    bundle.Center(component.partner).cwiseAbs().maxCoeff(&component.fixed_axis);
  }
}

}  // namespace

Bundle SelectBundle(const ColmapModel& model, BundleCertificate& certificate) {
  RequireFinite(model);
  std::vector<Candidate> candidates = VisibleObservations(model, certificate);
  KeepTied(candidates);
  Bundle bundle;
  std::map<uint32_t, size_t> cameras, images;
  std::map<uint64_t, size_t> points;
  for (const Candidate& c : candidates) images[c.image], points[c.point];
  for (const auto& [id, image] : model.images) {
    if (!images.contains(id))
      certificate.images_left_out.push_back(image.name);
    else
      cameras[image.camera_id];
  }
  for (const auto& [id, point] : model.points) {
    if (!points.contains(id)) certificate.points_left_out.push_back(id);
  }
  for (auto& [id, index] : cameras) {
    const ColmapCamera& camera = model.cameras.at(id);
    index = bundle.cameras.size();
    bundle.cameras.push_back({id, camera.model, camera.width, camera.height, camera.params.size()});
  }
  for (auto& [id, index] : images) {
    index = bundle.images.size();
    bundle.images.push_back({id, cameras.at(model.images.at(id).camera_id), 0});
  }
  for (size_t k = 0; k < bundle.cameras.size(); ++k) {
    const auto n_images = size_t(std::count_if(bundle.images.begin(), bundle.images.end(),
                                               [k](const Bundle::Image& image) { return image.camera == k; }));
    bundle.cameras[k].free[Bundle::kPrincipal] = n_images >= kFewestForPrincipal;
    if (n_images < kFewestForPrincipal) ++certificate.n_principal_held;
  }
  for (auto& [id, index] : points) {
    index = bundle.points.size();
    bundle.points.push_back({id, 0});
  }
  for (const Candidate& c : candidates) bundle.observations.push_back({images[c.image], points[c.point], c.px});
  certificate.n_observations = bundle.observations.size();
  certificate.n_points = bundle.points.size();
  std::vector<size_t> lengths(bundle.points.size());
  for (const Bundle::Observation& o : bundle.observations) ++lengths[o.point];
  for (const size_t length : lengths) {
    if (certificate.track_lengths.size() <= length) certificate.track_lengths.resize(length + 1);
    ++certificate.track_lengths[length];
  }
  if (bundle.images.empty()) {
    certificate.degeneracy = model.images.size() < 2 ? "one image only: nothing fixes the points' distances"
                                                     : "no two images are tied by " + std::to_string(kFewestPoints) +
                                                           " points that both of them see";
    return bundle;
  }
  FindComponents(bundle);
  ChooseFrames(model, bundle, certificate);
  if (!certificate.degeneracy) FillValues(model, bundle);
  return bundle;
}

}  // namespace nrff
