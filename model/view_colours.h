// The exposure and white balance in which a view is shown.
#pragma once

#include <array>
#include <vector>

#include "model/nrff_field.h"
#include "pipeline/scene.h"
#include "render/kernels/colour_correction.h"

namespace nrff {

using ColourCorrection = std::array<float, kCorrectionParameters>;

// The colour corrections of a field's training views, and what they say of other views.
class ViewColours {
 public:
  // None where the field has none. `training`: the scene's training views, in its order. Throws InputError when the
  // field was trained on another number of them.
  ViewColours(const NrffField& field, std::vector<View> training);

  bool empty() const { return training_.empty(); }

  // That of a training view; for another, the mean of its nearest training views', weighted by the inverse square of
  // their distance in place and direction: cameras that choose their exposures choose alike where they see alike, and
  // nothing of a held-out photo is used. On fox the spread of exposures is 0.38 EV, and 0.07 EV about this mean.
  ColourCorrection Of(const View& view) const;

 private:
  std::vector<View> training_;
  torch::Tensor corrections_;  // [n, 12] float
  double unit_ = 1;            // of distance: the median of the training views' from their middle
};

// rgb [n, 3] in place, opacity [n].
void CorrectColours(const ColourCorrection& correction, double background, int64_t n, const float* opacity, float* rgb);

}  // namespace nrff
