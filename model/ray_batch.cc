#include "model/ray_batch.h"

#include <ATen/ATen.h>

#include <algorithm>

#include "pipeline/error.h"
#include "render/kernels/pixel_ray.h"
#include "render/kernels/random.h"

namespace nrff {

using torch::Tensor;

double BackgroundLevel(const Scene& scene, double unknown_background) {
  switch (scene.background) {
    case Background::kWhite:
      return 1;
    case Background::kBlack:
      return 0;
    case Background::kNone:
      break;
  }
  return unknown_background;
}

PixelSource::PixelSource(std::vector<View> views, const ImagePack& pack, double background)
    : views_(std::move(views)), pack_(pack), background_(background), pixels_before_{0} {
  for (const View& view : views_) pixels_before_.push_back(pixels_before_.back() + uint64_t(view.width) * view.height);
  if (pixels_before_.back() == 0) throw InputError("the scene has no training views; nothing can be learnt from it");
}

PixelSource::Batch PixelSource::Draw(int64_t n, uint64_t seed, uint64_t step) const {
  const uint64_t stream = StreamAt(RandomStream::kBatch, step);
  Tensor pixels = at::empty({n, 3}, torch::kInt);
  auto* out = pixels.mutable_data_ptr<int32_t>();
  for (int64_t i = 0; i < n; ++i) {
    const uint64_t drawn = UniformBelow(pixels_before_.back(), seed, stream, i);
    const auto after = std::upper_bound(pixels_before_.begin(), pixels_before_.end(), drawn);
    const auto view = int32_t(after - pixels_before_.begin()) - 1;
    const auto within = int32_t(drawn - pixels_before_[view]);
    out[3 * i] = view;
    out[3 * i + 1] = within % views_[view].width;
    out[3 * i + 2] = within / views_[view].width;
  }
  return At(pixels);
}

PixelSource::Batch PixelSource::At(const Tensor& pixels) const {
  const int64_t n = pixels.size(0);
  const auto* pixel = pixels.const_data_ptr<int32_t>();
  Batch batch{RaysThroughPixels(views_, pixels, torch::kFloat), at::empty({n, 3}, torch::kFloat),
              pixels.select(1, 0).contiguous()};
  auto* target = batch.target.mutable_data_ptr<float>();
  const auto background = float(background_);
  for (int64_t i = 0; i < n; ++i) {
    const View& view = views_[pixel[3 * i]];
    const uint64_t index = uint64_t(pixel[3 * i + 2]) * view.width + pixel[3 * i + 1];
    const uint8_t* colour = pack_.Pixels(view) + index * view.channels;
    PixelColour(colour, view.channels, background, target + 3 * i);
  }
  return batch;
}

}  // namespace nrff
