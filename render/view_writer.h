// The payload of a render artifact: one colour, depth, normal and opacity image per view, and renders.json, as
// ARCHITECTURE.md describes them.
#pragma once

#include <filesystem>
#include <functional>
#include <string>
#include <vector>

#include "pipeline/scene.h"
#include "render/image_renderer.h"

namespace nrff {

inline constexpr char kRendersFile[] = "renders.json";
inline constexpr int kRendersSchemaVersion = 1;
// The payload's directories.
inline constexpr const char* kRenderLayers[] = {"rgb", "depth", "normal", "opacity"};

struct RenderFacts {
  int n_views = 0;
  int n_kept = 0;  // of an earlier, interrupted attempt
  double seconds_per_view = 0;
  double samples_per_ray = 0;  // density evaluations
};

// What to render with.
struct RenderSource {
  const RadianceField& field;
  const OccupancyGrid& occupancy;
  SceneMap map;
  RenderOptions options;
  int bits = 8;  // of the colours: 8, or 16 without the tolerance of colours that 8 hide
  // RenderImage of this source by other means than the CPU's; null: RenderImage.
  std::function<RenderedImage(const View& view, const RenderOptions& options)> render = {};
  // What is done to a view's image before it is written; null: nothing.
  std::function<void(const View& view, RenderedImage& image)> finish = {};
};

// Renders the views into `dir`. A view that an interrupted attempt finished there (dir/done/ID.json, written after its
// images) is kept. `split` overrides what renders.json says of the views' split ("path" for the frames of a film);
// empty: the views' own. Throws CorruptError when the model yields values that are not numbers.
RenderFacts RenderViews(const RenderSource& source, const std::vector<View>& views, const std::string& split,
                        const std::filesystem::path& dir);

}  // namespace nrff
