// Error against run time of what rendering leaves out, on real views: one setting is varied at a time and nothing else
// is left out; one family has them together, as nrff-render does.
//
// Two references, both with every sample shaded in float: `limit`, with an eighth of the step, and `exact`, with the
// step of the setting at hand. The step's error is told from the first, the others' from the second.
#pragma once

#include <vector>

#include "pipeline/json.h"
#include "render/view_writer.h"

namespace nrff {

// What a view's photo shows, for the error that people see.
struct TrueColours {
  std::vector<float> rgb;  // [height, width, 3] in [0, 1], composited on the background
};

// {n_views, reference_seconds: a view at the limit,
//  families [{family, unit, meaning, reference: "limit" | "exact",
//    points [{value, seconds: a view, least of 1 to 8 times, rmse, most: of RGB in [0, 1], psnr: to the photos, dB,
//             samples_per_ray, shaded_per_ray, chosen: the value that nrff-render uses}]}]}
// Points are from coarse to fine. `truth`: one per view. Shows progress.
Json RenderingWorkPrecision(const RenderSource& source, const std::vector<View>& views,
                            const std::vector<TrueColours>& truth);

// Quadrature of the transmittance integral over a unit length against closed forms, in float as rendering does it:
// [{density, points [{n_samples, error: |T − exact|, seconds: a ray}]}]. Densities: constant, linear, Gaussian, step.
Json QuadratureWorkPrecision();

}  // namespace nrff
