// How well a model shows views it was not trained on, measured while it trains. Nothing is decided by it.
#pragma once

#include <torch/types.h>

#include <functional>
#include <string>
#include <vector>

#include "model/ray_batch.h"
#include "pipeline/scene.h"
#include "render/volume_renderer.h"

namespace nrff {

// PSNR over a fixed lattice of pixels of up to eight held-out views, spread over their order: the mean over the views
// of each view's PSNR, in dB, not quantised.
class HeldOutViews {
 public:
  static constexpr int kMostViews = 8;
  static constexpr int kMostPixels = 4096;  // of each view

  // Reads the pixels at once.
  HeldOutViews(const Scene& scene, const ImagePack& pack, double background);

  bool empty() const { return batches_.empty(); }
  // render: rays of a view → their colours [n, 3].
  using Render = std::function<torch::Tensor(const View& view, const Rays& rays)>;
  // corrected: a view as it is rendered; null: as the scene has it.
  double Psnr(const Render& render, const std::function<View(const View&)>& corrected = {}) const;
  // For facts.curve_protocol.
  std::string Protocol() const;

 private:
  std::vector<View> views_;
  std::vector<torch::Tensor> pixels_;  // of views_, for PixelSource::At
  std::vector<PixelSource::Batch> batches_;
};

}  // namespace nrff
