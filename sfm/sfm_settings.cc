#include "sfm/sfm_settings.h"

#include <utility>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/files.h"

namespace nrff {
namespace {

CameraModel CameraModelIn(const Json& json, const std::string& where) {
  const auto name = Get<std::string>(json, "camera_model", where);
  if (const auto model = CameraModelNamed(name)) return *model;
  throw CorruptError(where + ": \"camera_model\" is " + EscapePath(name) + ", which is none of COLMAP's; run with " +
                     "--force to make everything anew");
}

}  // namespace

Json ToJson(const SfmSettings& settings) {
  Json lenses = Json::array();
  for (const auto& [group, lens] : settings.lenses) {
    lenses.push_back({{"group", group},
                      {"camera_model", CameraModelName(lens.model)},
                      {"width", lens.width},
                      {"height", lens.height},
                      {"params", lens.params}});
  }
  return {{"name", settings.name},
          {"max_image_size", settings.max_image_size},
          {"max_features", settings.max_features},
          {"first_octave", settings.first_octave},
          {"peak_threshold", settings.peak_threshold},
          {"n_neighbours", settings.n_neighbours},
          {"tolerant_mapping", settings.tolerant_mapping},
          {"camera_model", CameraModelName(settings.camera_model)},
          {"lenses", std::move(lenses)}};
}

SfmSettings SfmSettingsFromJson(const Json& json, const std::string& where) {
  SfmSettings settings;
  settings.name = Get<std::string>(json, "name", where);
  settings.max_image_size = Get<int>(json, "max_image_size", where);
  settings.max_features = Get<int>(json, "max_features", where);
  settings.first_octave = Get<int>(json, "first_octave", where);
  settings.peak_threshold = Get<double>(json, "peak_threshold", where);
  settings.n_neighbours = Get<int>(json, "n_neighbours", where);
  settings.tolerant_mapping = Get<bool>(json, "tolerant_mapping", where);
  settings.camera_model = CameraModelIn(json, where);
  for (const Json& lens : Get<std::vector<Json>>(json, "lenses", where)) {
    const CameraModel model = CameraModelIn(lens, where);
    const auto params = Get<std::vector<double>>(lens, "params", where);
    if (params.size() != size_t(CameraModelParamCount(model))) {
      throw CorruptError(where + ": a lens of the model " + CameraModelName(model) + " has " +
                         std::to_string(params.size()) + " parameters, expected " +
                         std::to_string(CameraModelParamCount(model)) + "; run with --force to make everything anew");
    }
    settings.lenses[Get<int>(lens, "group", where)] = {0, model, Get<int>(lens, "width", where),
                                                       Get<int>(lens, "height", where), params};
  }
  return settings;
}

}  // namespace nrff
