#include "tests/fuzz/model_laws.h"

#include <algorithm>
#include <cmath>

#include "tests/fuzz/fuzz.h"

namespace nrff::fuzz {
namespace {

bool Same(double a, double b) { return a == b || (std::isnan(a) && std::isnan(b)); }

bool Same(const ColmapCamera& a, const ColmapCamera& b) {
  return a.id == b.id && a.model == b.model && a.width == b.width && a.height == b.height && a.params == b.params;
}

bool Same(const ColmapImage& a, const ColmapImage& b) {
  const auto same_observation = [](const ColmapObservation& p, const ColmapObservation& q) {
    return Same(p.x, q.x) && Same(p.y, q.y) && p.point_id == q.point_id;
  };
  return a.id == b.id && a.camera_id == b.camera_id && a.name == b.name &&
         (a.rotation.coeffs() - b.rotation.coeffs()).norm() < 1e-14 && a.translation == b.translation &&
         std::equal(a.observations.begin(), a.observations.end(), b.observations.begin(), b.observations.end(),
                    same_observation);
}

bool Same(const ColmapPoint& a, const ColmapPoint& b) {
  return a.position == b.position && a.rgb == b.rgb && Same(a.error_px, b.error_px) && a.track == b.track;
}

template <typename Key, typename Value>
bool Same(const std::map<Key, Value>& a, const std::map<Key, Value>& b) {
  return std::equal(a.begin(), a.end(), b.begin(), b.end(),
                    [](const auto& p, const auto& q) { return p.first == q.first && Same(p.second, q.second); });
}

}  // namespace

void RequireSame(const ColmapModel& a, const ColmapModel& b) {
  Require(Same(a.cameras, b.cameras), "cameras that are written are read as they were");
  Require(Same(a.images, b.images), "images that are written are read as they were");
  Require(Same(a.points, b.points), "points that are written are read as they were");
}

void RequireUsable(const Source& source) {
  Require(source.model.has_value(), "a posed capture has poses");
  Require(!source.images.empty() && source.images.size() == source.model->images.size(),
          "a posed capture has as many poses as photos");
  if (source.box) {
    for (int axis = 0; axis < 3; ++axis) {
      const double low = (*source.box)[axis], high = (*source.box)[axis + 3];
      Require(std::isfinite(low) && std::isfinite(high) && low < high, "the box is finite and not empty");
    }
  }
  const std::filesystem::path folder = Folder() / "written";
  WriteColmapBinary(*source.model, folder);
  RequireSame(*source.model, ReadColmapModel(folder));
}

}  // namespace nrff::fuzz
