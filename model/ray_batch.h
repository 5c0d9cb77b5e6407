// Batches of rays through random pixels, with the colours they should have.
#pragma once

#include <torch/types.h>

#include <cstdint>
#include <utility>
#include <vector>

#include "pipeline/scene.h"
#include "render/volume_renderer.h"

namespace nrff {

// Grey level that pixels are composited onto and that lies behind everything.
double BackgroundLevel(const Scene& scene, double unknown_background);

// The pixels of some views. Keeps references to both arguments.
class PixelSource {
 public:
  // Throws InputError when there is no pixel, or none that counts.
  PixelSource(std::vector<View> views, const ImagePack& pack, double background);

  struct Batch {
    Rays rays;
    torch::Tensor target;  // [n, 3] in [0, 1]
    torch::Tensor view;    // [n] int32, index into views()
  };

  // n pixels, uniform over all pixels that count of all views, from the stream (seed, kBatch at step).
  Batch Draw(int64_t n, uint64_t seed, uint64_t step) const;

  // pixels [n_each · views, 3] for At: of each view with pixels that count, from the stream (seed, kCameraPixels at
  // counter).
  torch::Tensor DrawOfEachView(int64_t n_each, uint64_t seed, uint64_t counter) const;

  // pixels [n, 3] int32: (view, ix, iy).
  Batch At(const torch::Tensor& pixels) const;

  // The same views with other cameras.
  void MoveViews(std::vector<View> views) { views_ = std::move(views); }

  const std::vector<View>& views() const { return views_; }
  const ImagePack& pack() const { return pack_; }
  // [n_views + 1]: how many count in the views before.
  const std::vector<uint64_t>& pixels_before() const { return pixels_before_; }
  // CountingPixel's rows_before of masked views, one after the other in the order of views().
  const std::vector<uint32_t>& rows_before() const { return rows_before_; }

 private:
  // (view, ix, iy) of the pixel that is number `within` of those that count.
  void Locate(int32_t view, uint64_t within, int32_t* pixel) const;

  std::vector<View> views_;
  const ImagePack& pack_;
  double background_;
  std::vector<uint64_t> pixels_before_;
  std::vector<uint32_t> rows_before_;
  std::vector<size_t> first_row_;  // of a view in rows_before_
};

}  // namespace nrff
