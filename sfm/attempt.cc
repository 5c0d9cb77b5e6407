#include "sfm/attempt.h"

#include <algorithm>
#include <utility>

namespace nrff {

const ColmapModel* LargestModel(const std::vector<ColmapModel>& models) {
  const auto size = [](const ColmapModel& m) { return std::pair(m.images.size(), m.points.size()); };
  const auto largest =
      std::max_element(models.begin(), models.end(), [&](const auto& a, const auto& b) { return size(a) < size(b); });
  return largest == models.end() ? nullptr : &*largest;
}

const ColmapModel* BestModel(const Attempt& attempt) {
  const ColmapModel* largest = LargestModel(attempt.models);
  if (!attempt.grown) return largest;
  return largest && largest->images.size() > attempt.grown->images.size() ? largest : &*attempt.grown;
}

size_t NumRegistered(const Attempt& attempt) {
  const ColmapModel* best = BestModel(attempt);
  return best ? best->images.size() : 0;
}

}  // namespace nrff
