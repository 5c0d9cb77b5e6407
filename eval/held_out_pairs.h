// The held-out views of a scene, photo and render, as they lie on disk.
#pragma once

#include <filesystem>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "eval/image_file.h"
#include "pipeline/manifest.h"
#include "pipeline/scene.h"

namespace nrff {

class HeldOutPairs {
 public:
  // Of the artifacts `scene_dir` (pose) and `renders_dir` (render).
  HeldOutPairs(const std::filesystem::path& scene_dir, const std::filesystem::path& renders_dir);

  // Those of which a pixel counts.
  size_t size() const { return held_out_.size(); }
  const View& ViewOf(size_t i) const { return scene_.views[held_out_[i]]; }
  const std::vector<HashedPath>& inputs() const { return inputs_; }
  const std::string& split_rule() const { return split_rule_; }
  // Which exposures the views were rendered in.
  const std::string& exposures() const { return exposures_; }
  // What alpha is composited on; none where no photo has alpha.
  Background background() const;
  // Whether pixels of some held-out view do not count.
  bool masked() const;

  struct Pair {
    StoredImage photo, rendered;
    std::vector<uint8_t> truth;  // the photo over the background, 8 bits
    std::optional<Mask> counts;  // of a masked view: which pixels count
    std::filesystem::path rendered_path;
  };
  // From any thread. Throws InputError when the view was not rendered or has another size than its photo.
  Pair Read(size_t i) const;

 private:
  std::filesystem::path renders_dir_;
  std::vector<HashedPath> inputs_;
  std::string split_rule_, exposures_;
  Scene scene_;
  ImagePack pack_;
  std::vector<int> held_out_;
  std::map<std::string, std::string> rendered_paths_;  // by id, relative to the render artifact
};

// The 8-bit picture's values.
RgbImage FromEightBits(int width, int height, const std::vector<uint8_t>& rgb);

}  // namespace nrff
