// The example scene: glossy and matt objects on a paved ground under a painted sky, and cameras that walk round it.
//
// Everything is textured at all scales and nothing repeats, so that feature matching has one answer.
#pragma once

#include <cstdint>
#include <vector>

#include "examples/ray_tracer.h"

namespace nrff {

enum class Finish { kDiffuse, kGlossy };

// With kDiffuse nothing shows a highlight or a reflection: colours do not depend on the view.
World MakeStillLife(Finish finish, uint32_t seed);

// Two rings at different heights, walked one after the other, with the irregularities of a hand-held camera. The second
// ring looks from between the first one's places. Fewer than 24 views cover a part of the circle and stand closer
// together, so that each overlaps with several others. Poses alone.
std::vector<Camera> MakeOrbit(int n_views, uint32_t seed);

}  // namespace nrff
