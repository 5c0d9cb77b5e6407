#include "model/held_out.h"

#include <ATen/ATen.h>
#include <c10/core/GradMode.h>

#include <algorithm>
#include <cmath>

namespace nrff {
namespace {

using torch::Tensor;

// Every `stride`-th pixel of both axes, from the middle of the first stride, where it counts: [n, 3] int32 (0, ix, iy).
Tensor Lattice(const View& view, const uint8_t* image, int n_most) {
  int stride = 1;
  while ((view.width / stride) * int64_t(view.height / stride) > n_most) ++stride;
  std::vector<int32_t> pixels;
  for (int y = stride / 2; y < view.height; y += stride) {
    for (int x = stride / 2; x < view.width; x += stride) {
      const uint8_t* pixel = image + (int64_t(y) * view.width + x) * view.channels;
      if (!view.masked || pixel[3] == 255) pixels.insert(pixels.end(), {0, x, y});
    }
  }
  return at::tensor(pixels, torch::kInt).view({-1, 3});
}

}  // namespace

HeldOutViews::HeldOutViews(const Scene& scene, const ImagePack& pack, double background) {
  const std::vector<int> held_out = scene.ViewsOf(Split::kTest);
  const size_t n_views = std::min<size_t>(held_out.size(), kMostViews);
  for (size_t i = 0; i < n_views; ++i) {
    const View& view = scene.views[held_out[i * held_out.size() / n_views]];
    const Tensor lattice = Lattice(view, pack.Pixels(view), kMostPixels);
    if (lattice.size(0) == 0) continue;
    views_.push_back(view);
    pixels_.push_back(lattice);
    batches_.push_back(PixelSource({view}, pack, background).At(lattice));
  }
}

double HeldOutViews::Psnr(const Render& render, const std::function<View(const View&)>& corrected) const {
  const c10::NoGradGuard no_grad;
  double sum = 0;
  for (size_t i = 0; i < batches_.size(); ++i) {
    const View view = corrected ? corrected(views_[i]) : views_[i];
    const Rays rays = corrected ? RaysThroughPixels({view}, pixels_[i], torch::kFloat) : batches_[i].rays;
    const Tensor rgb = render(view, rays).clamp(0, 1);
    sum += -10 * std::log10(at::mse_loss(rgb, batches_[i].target).item<double>());
  }
  return sum / double(batches_.size());
}

std::string HeldOutViews::Protocol() const {
  return "mean PSNR of " + std::to_string(batches_.size()) + " held-out views spread over their order, each over a " +
         "lattice of about " + std::to_string(kMostPixels) +
         " of its pixels at full resolution, in [0, 1], not quantised";
}

}  // namespace nrff
