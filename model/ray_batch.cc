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
  for (const View& view : views_) {
    first_row_.push_back(rows_before_.size());
    uint64_t n = uint64_t(view.width) * view.height;
    if (view.masked) {
      const uint8_t* pixel = pack_.Pixels(view);
      n = 0;
      for (int y = 0; y < view.height; ++y) {
        rows_before_.push_back(uint32_t(n));
        for (int x = 0; x < view.width; ++x, pixel += view.channels) n += pixel[3] == 255;
      }
      rows_before_.push_back(uint32_t(n));
    }
    pixels_before_.push_back(pixels_before_.back() + n);
  }
  if (pixels_before_.back() == 0)
    throw InputError("the scene has no pixel that counts in a training view; nothing can be learnt from it");
}

PixelSource::Batch PixelSource::Draw(int64_t n, uint64_t seed, uint64_t step) const {
  const uint64_t stream = StreamAt(RandomStream::kBatch, step);
  Tensor pixels = at::empty({n, 3}, torch::kInt);
  auto* out = pixels.mutable_data_ptr<int32_t>();
  for (int64_t i = 0; i < n; ++i) {
    const uint64_t drawn = UniformBelow(pixels_before_.back(), seed, stream, i);
    const auto after = std::upper_bound(pixels_before_.begin(), pixels_before_.end(), drawn);
    const auto view = int32_t(after - pixels_before_.begin()) - 1;
    Locate(view, drawn - pixels_before_[view], out + 3 * i);
  }
  return At(pixels);
}

Tensor PixelSource::DrawOfEachView(int64_t n_each, uint64_t seed, uint64_t counter) const {
  const uint64_t stream = StreamAt(RandomStream::kCameraPixels, counter);
  std::vector<int32_t> pixels;
  for (size_t view = 0; view < views_.size(); ++view) {
    const uint64_t n_counting = pixels_before_[view + 1] - pixels_before_[view];
    for (int64_t i = 0; i < n_each && n_counting > 0; ++i) {
      const uint64_t drawn = UniformBelow(n_counting, seed, stream, int64_t(view) * n_each + i);
      pixels.resize(pixels.size() + 3);
      Locate(int32_t(view), drawn, pixels.data() + pixels.size() - 3);
    }
  }
  return at::tensor(pixels, torch::kInt).view({-1, 3});
}

void PixelSource::Locate(int32_t view, uint64_t within, int32_t* pixel) const {
  const View& of = views_[view];
  pixel[0] = view;
  if (of.masked) {
    CountingPixel(pack_.Pixels(of), rows_before_.data() + first_row_[view], of.width, of.height, uint32_t(within),
                  pixel + 1, pixel + 2);
  } else {
    pixel[1] = int32_t(within % uint64_t(of.width));
    pixel[2] = int32_t(within / uint64_t(of.width));
  }
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
