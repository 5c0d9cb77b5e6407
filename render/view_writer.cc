#include "render/view_writer.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"
#include "pipeline/progress.h"
#include "render/png.h"

namespace nrff {
namespace {

// Figures of one finished view: its mark in dir/done.
struct ViewRecord {
  double seconds = 0;
  double n_samples = 0;
};

// Value in [0, 1] → 0 … Max(Integer), rounded.
template <typename Integer>
Integer Quantise(float value) {
  constexpr auto kMax = static_cast<float>(std::numeric_limits<Integer>::max());
  return static_cast<Integer>(std::lround(std::clamp(value, 0.F, 1.F) * kMax));
}

template <typename Integer, typename ToUnit>
std::vector<Integer> QuantiseAll(const std::vector<float>& values, ToUnit&& to_unit) {
  std::vector<Integer> out(values.size());
  std::transform(values.begin(), values.end(), out.begin(), [&](float v) { return Quantise<Integer>(to_unit(v)); });
  return out;
}

// Depth beyond this saturates. In unbounded scenes `far` can be so far off that sharing 65535 steps with it would
// leave few for the subject.
double DepthRange(const RenderSource& source) {
  const auto& h = source.map.half_extent;
  const double diagonal = 2 * std::hypot(h[0], h[1], h[2]);
  return source.map.unbounded ? std::min(source.options.far, 8 * diagonal) : source.options.far;
}

std::string LayerPath(const char* layer, const View& view) { return std::string(layer) + "/" + view.id + ".png"; }
std::filesystem::path RecordPath(const std::filesystem::path& dir, const View& view) {
  return dir / "done" / (view.id + ".json");
}

void WriteImage(const RenderedImage& image, const View& view, double depth_range, const std::filesystem::path& dir,
                int bits) {
  for (const std::vector<float>* layer : {&image.rgb, &image.depth, &image.normal, &image.opacity}) {
    if (!std::all_of(layer->begin(), layer->end(), [](float v) { return std::isfinite(v); })) {
      throw CorruptError("the model gives values that are not numbers in view " + view.name + "; train it again");
    }
  }
  const int w = image.width, h = image.height;
  const auto unit = [](float v) { return v; };
  const auto inverse_range = static_cast<float>(1 / depth_range);
  if (bits == 16) {
    WritePng(dir / LayerPath("rgb", view), w, h, 3, QuantiseAll<uint16_t>(image.rgb, unit));
  } else {
    WritePng(dir / LayerPath("rgb", view), w, h, 3, QuantiseAll<uint8_t>(image.rgb, unit));
  }
  WritePng(dir / LayerPath("depth", view), w, h, 1,
           QuantiseAll<uint16_t>(image.depth, [&](float v) { return v * inverse_range; }));
  WritePng(dir / LayerPath("normal", view), w, h, 3,
           QuantiseAll<uint8_t>(image.normal, [](float v) { return 0.5F * (v + 1); }));
  WritePng(dir / LayerPath("opacity", view), w, h, 1, QuantiseAll<uint8_t>(image.opacity, unit));
}

void WriteRenders(const std::vector<View>& views, const std::string& split, double depth_range,
                  const std::filesystem::path& dir) {
  Json entries = Json::array();
  for (const View& view : views) {
    Json entry{{"id", view.id}, {"name", view.name}, {"width", view.width}, {"height", view.height}};
    entry["split"] = !split.empty() ? split : view.split == Split::kTrain ? "train" : "test";
    for (const char* layer : kRenderLayers) entry[layer] = LayerPath(layer, view);
    entries.push_back(std::move(entry));
  }
  WriteJson(dir / kRendersFile,
            Json{{"schema_version", kRendersSchemaVersion}, {"depth_unit", depth_range / 65535}, {"views", entries}});
}

}  // namespace

RenderFacts RenderViews(const RenderSource& source, const std::vector<View>& views, const std::string& split,
                        const std::filesystem::path& dir) {
  for (const char* layer : kRenderLayers) std::filesystem::create_directories(dir / layer);
  std::filesystem::create_directories(dir / "done");
  const double depth_range = DepthRange(source);

  const RenderOptions options = PictureOptions(source.options, source.bits);

  Progress progress("rendering", static_cast<double>(views.size()), "views");
  RenderFacts facts;
  double seconds = 0, n_samples = 0, n_rays = 0;
  for (const View& view : views) {
    ViewRecord record;
    const double n_view_rays = static_cast<double>(view.width) * view.height;
    if (std::filesystem::exists(RecordPath(dir, view))) {
      const std::string where = EscapePath(RecordPath(dir, view));
      const Json json = ReadJson(RecordPath(dir, view));
      record = {Get<double>(json, "seconds", where), Get<double>(json, "n_samples", where)};
      ++facts.n_kept;
    } else {
      const auto start = std::chrono::steady_clock::now();
      RenderedImage image = source.render
                                ? source.render(view, options)
                                : RenderImage(source.field, source.occupancy, source.map, view, options,
                                              [&](int64_t n) { progress.Update(facts.n_views + n / n_view_rays); });
      if (source.finish) source.finish(view, image);
      record.seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
      record.n_samples = static_cast<double>(image.n_samples);
      WriteImage(image, view, depth_range, dir, source.bits);
      WriteJson(RecordPath(dir, view), Json{{"seconds", record.seconds}, {"n_samples", record.n_samples}});
    }
    ++facts.n_views;
    seconds += record.seconds;
    n_samples += record.n_samples;
    n_rays += n_view_rays;
    progress.Update(facts.n_views);
  }
  progress.Done();
  WriteRenders(views, split, depth_range, dir);
  if (facts.n_views > 0) {
    facts.seconds_per_view = seconds / facts.n_views;
    facts.samples_per_ray = n_samples / n_rays;
  }
  return facts;
}

}  // namespace nrff
