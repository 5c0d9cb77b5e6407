// LPIPS [Zhang18]: how different two images are to the features of a network that was trained on photos.
//
//     Σ_l 1/(H_l W_l) Σ_hw Σ_c w_lc (â_lchw − b̂_lchw)²
//
// over five layers l of the backbone, with features scaled to unit length at every pixel. Backbone and weights come
// from a file that eval/export_lpips.py writes, which says what is in it.
#pragma once

#include <filesystem>
#include <memory>
#include <optional>
#include <string>

#include "eval/metrics.h"

namespace nrff {

inline constexpr int kLpipsSmallest = 32;  // px: below, the backbones have no pixels left

class LpipsNetwork {
 public:
  // Throws InputError naming the file when it is not one of export_lpips.py, is damaged (its hash differs) or holds
  // what OpenCV cannot run.
  explicit LpipsNetwork(const std::filesystem::path& file);
  ~LpipsNetwork();

  // Throws InputError unless this is LPIPS as published: its backbone, and not a random one.
  void RequirePublished() const;

  const std::string& network() const { return network_; }    // vgg, alex
  const std::string& version() const { return version_; }    // of the weights, as 0.1
  const std::string& backbone() const { return backbone_; }  // published, random
  const std::string& hash() const { return hash_; }          // of all constants

  // 0 for equal images. Nothing when a side is below kLpipsSmallest. Both of one size, in [0, 1]. One call at a time.
  std::optional<double> Distance(const RgbImage& truth, const RgbImage& rendered);

 private:
  struct Runner;

  std::filesystem::path file_;
  std::string network_, version_, backbone_, hash_;
  std::unique_ptr<Runner> runner_;
};

}  // namespace nrff
