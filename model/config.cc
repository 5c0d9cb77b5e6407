#include "model/config.h"

#include <algorithm>
#include <cmath>
#include <sstream>
#include <stdexcept>
#include <utility>

#include "model/kernels/feature_grid.h"
#include "model/kernels/ree.h"
#include "pipeline/error.h"

namespace nrff {
namespace {

constexpr double kDepthWeight = 0.1;  // 0.3 and 1 show held-out training views of castle and the example worse
constexpr const char* kActivations[] = {"gelu", "relu"};  // in the order of Activation

// The place of the JSON string among names. Throws std::invalid_argument where it is not there.
template <typename Names>
size_t IndexOf(const Json& json, const Names& names, const char* what) {
  const auto name = json.get<std::string>();
  const auto found = std::find(std::begin(names), std::end(names), name);
  if (found == std::end(names)) throw std::invalid_argument(std::string(what) + " is '" + name + "'");
  return size_t(found - std::begin(names));
}

}  // namespace

static void to_json(Json& json, Activation activation) { json = kActivations[size_t(activation)]; }
static void from_json(const Json& json, Activation& activation) {
  activation = Activation(IndexOf(json, kActivations, "activation"));
}

static void to_json(Json& json, DirectionalEncoding encoding) { json = kDirectionalEncodings[size_t(encoding)]; }
static void from_json(const Json& json, DirectionalEncoding& encoding) {
  encoding = DirectionalEncoding(IndexOf(json, kDirectionalEncodings, "directional_encoding"));
}

// to_json and from_json; the latter throws when a key is missing.
NLOHMANN_DEFINE_TYPE_NON_INTRUSIVE(FieldConfig, levels, base_resolution, max_resolution, density_channels,
                                   appearance_channels, appearance_line_mean, density_scale, density_shift,
                                   decoded_features, spatial_layers, spatial_width, bottleneck_width, lobes_theta,
                                   lobes_phi, lobe_row_width, directional_encoding, directional_layers,
                                   directional_width, activation, corrected_views)
NLOHMANN_DEFINE_TYPE_NON_INTRUSIVE(TrainConfig, steps, rays, max_rays, target_shaded, grid_rate, network_rate,
                                   correction_rate, final_rate, beta1, beta2, epsilon, lazy_grids, average_from,
                                   average_interval, reset_with_step, orientation_weight, density_l1_weight,
                                   density_l1_weight_later, sparsity_weight, depth_weight, depth_rays,
                                   correction_weight, camera_moments, camera_pixels, camera_least_px, step_voxels,
                                   step_moments, step_ratio, occupancy_resolution, occupancy_moments,
                                   occupancy_interval, occupancy_cells, occupancy_threshold, occupancy_decay,
                                   occupancy_dilate, occupancy_min_views, shrink_moments, weight_threshold_first,
                                   weight_threshold_last, weight_threshold_moment, unknown_background)

Json ToJson(const FieldConfig& config) { return config; }
Json ToJson(const TrainConfig& config) { return config; }

namespace {

// Throws std::invalid_argument naming what cannot be.
void CheckConfig(const FieldConfig& config) {
  constexpr int kMost = 1 << 14;  // beyond any network that fits in memory
  constexpr int kMostViews = 1 << 20;
  const std::pair<const char*, int> sizes[] = {{"levels", config.levels},
                                               {"max_resolution", config.max_resolution},
                                               {"spatial_layers", config.spatial_layers},
                                               {"spatial_width", config.spatial_width},
                                               {"bottleneck_width", config.bottleneck_width},
                                               {"lobe_row_width", config.lobe_row_width},
                                               {"directional_layers", config.directional_layers},
                                               {"directional_width", config.directional_width}};
  for (const auto& [name, size] : sizes) {
    if (size < 1 || size > kMost) {
      throw std::invalid_argument(std::string(name) + " is " + std::to_string(size) + ", expected 1 to " +
                                  std::to_string(kMost));
    }
  }
  if (config.decoded_features < 0 || config.decoded_features > kMost) {
    throw std::invalid_argument("decoded_features must not be negative, nor beyond " + std::to_string(kMost));
  }
  if (config.corrected_views < 0 || config.corrected_views > kMostViews) {
    throw std::invalid_argument("corrected_views must not be negative, nor beyond " + std::to_string(kMostViews));
  }
  MakeGridLayout(config.levels, config.base_resolution, config.max_resolution, config.density_channels);
  MakeGridLayout(config.levels, config.base_resolution, config.max_resolution, config.appearance_channels);
  MakeLobes(config.lobes_theta, config.lobes_phi);
}

void CheckConfig(const TrainConfig& config) {
  const auto check = [](bool holds, const char* what) {
    if (!holds) throw std::invalid_argument(what);
  };
  check(config.steps > 0 && config.rays > 0, "steps and rays must be positive");
  check(config.max_rays >= config.rays, "max_rays must be at least rays");
  check(config.grid_rate > 0 && config.network_rate > 0 && config.correction_rate > 0 && config.final_rate > 0 &&
            config.epsilon > 0,
        "rates and epsilon must be positive");
  check(config.beta1 >= 0 && config.beta1 < 1 && config.beta2 >= 0 && config.beta2 < 1, "betas lie in [0, 1)");
  check(config.average_from > 0 && config.average_interval > 0, "average_from and average_interval must be positive");
  check(config.average_from >= 1 || config.shrink_moments.empty() || config.average_from > config.shrink_moments.back(),
        "average_from must lie behind the last of shrink_moments");
  check(config.orientation_weight >= 0 && config.density_l1_weight >= 0 && config.density_l1_weight_later >= 0 &&
            config.sparsity_weight >= 0 && config.depth_weight >= 0 && config.correction_weight >= 0,
        "weights of losses must not be negative");
  check(config.depth_rays > 0, "depth_rays must be positive");
  check(config.camera_pixels > 0 && config.camera_least_px >= 0,
        "camera_pixels must be positive, camera_least_px not negative");
  check(config.camera_moments.empty() || config.camera_moments.back() < config.average_from,
        "average_from must lie behind the last of camera_moments");
  check(config.step_ratio > 0 && config.step_voxels.size() == config.step_moments.size() + 1,
        "step_voxels has one entry more than step_moments");
  for (const int voxels : config.step_voxels) check(voxels > 0, "step_voxels must be positive");
  for (const auto& moments :
       {config.step_moments, config.occupancy_moments, config.shrink_moments, config.camera_moments})
    check(std::is_sorted(moments.begin(), moments.end()), "moments must ascend");
  check(config.occupancy_resolution > 0 && config.occupancy_resolution <= 1024 && config.occupancy_resolution % 8 == 0,
        "occupancy_resolution is a multiple of 8 up to 1024");
  check(config.weight_threshold_first > 0 && config.weight_threshold_last > 0, "weight thresholds must be positive");
}

// Whether `given` can stand where `had` stands without being converted: 3.7 is no count, 1 no truth value.
bool SameKind(const Json& had, const Json& given) {
  if (had.is_array()) {
    if (!given.is_array()) return false;
    return std::all_of(given.begin(), given.end(),
                       [&](const Json& item) { return had.empty() ? item.is_number() : SameKind(had.front(), item); });
  }
  if (had.is_number_integer()) return given.is_number_integer();
  if (had.is_number()) return given.is_number();
  return had.type() == given.type();
}

}  // namespace

FieldConfig FieldConfigFromJson(const Json& json, const std::string& where) {
  try {
    // What models of earlier versions do not name.
    Json complete = {{"decoded_features", 0}, {"directional_encoding", "ree"}, {"corrected_views", 0}};
    complete.update(json);
    const auto config = complete.get<FieldConfig>();
    CheckConfig(config);
    return config;
  } catch (const std::exception& error) {
    throw CorruptError(where + ": the field's configuration cannot be used (" + error.what() + ")");
  }
}

void ApplySettings(const std::string& settings, Preset& preset) {
  Json json = {{"field", ToJson(preset.field)}, {"train", ToJson(preset.train)}};
  std::istringstream words(settings);
  for (std::string setting; words >> setting;) {
    const size_t dot = setting.find('.'), equals = setting.find('=');
    const std::string group = setting.substr(0, dot);
    if (equals == std::string::npos || dot > equals || !json.contains(group)) {
      throw UsageError("--set '" + setting + "' is not of the form field.KEY=VALUE or train.KEY=VALUE");
    }
    const std::string key = setting.substr(dot + 1, equals - dot - 1);
    if (!json[group].contains(key)) {
      std::string keys;
      for (const auto& item : json[group].items()) keys += (keys.empty() ? "" : ", ") + item.key();
      throw UsageError("--set '" + setting + "': there is no " + group + "." + key + "; there are " + keys);
    }
    Json& value = json[group][key];
    const Json given = Json::parse(setting.substr(equals + 1), nullptr, /*allow_exceptions=*/false);
    if (!SameKind(value, given)) {
      throw UsageError("--set '" + setting + "' has another kind of value than the preset's " + value.dump());
    }
    value = given;
  }
  try {
    const Preset changed = {json["field"].get<FieldConfig>(), json["train"].get<TrainConfig>()};
    if (ToJson(changed.field) != json["field"] || ToJson(changed.train) != json["train"]) {
      throw std::invalid_argument("a number is too large");
    }
    CheckConfig(changed.field);
    CheckConfig(changed.train);
    preset = changed;
  } catch (const std::exception& error) {
    throw UsageError("--set '" + settings + "' cannot be used: " + error.what());
  }
}

namespace {

// Every 25th of the training while it is young; what comes behind settles with the cameras as they are.
const std::vector<double> kCameraMoments = {0.15, 0.19, 0.23, 0.27, 0.31, 0.35, 0.39, 0.43, 0.47, 0.51, 0.55};

// What two cores train in a few minutes; tuned on training views that were held out.
Preset SmallPreset(bool unbounded) {
  Preset preset;
  FieldConfig& field = preset.field;
  field.levels = unbounded ? 8 : 12;
  field.base_resolution = 16;
  field.max_resolution = unbounded ? 256 : 192;
  field.appearance_line_mean = 1;
  field.density_scale = unbounded ? 60 : 25;
  field.density_shift = unbounded ? -5 : -4;
  field.spatial_layers = 2;
  field.spatial_width = 64;
  field.bottleneck_width = 32;
  field.lobes_theta = 4;
  field.lobes_phi = 8;
  field.directional_layers = 3;
  field.directional_width = 64;
  field.activation = Activation::kRelu;

  TrainConfig& train = preset.train;
  train.steps = 8000;
  train.rays = 1024;
  train.max_rays = 4096;
  train.target_shaded = unbounded ? 2048 : 4096;
  train.grid_rate = 0.03;
  train.network_rate = 3e-3;
  train.final_rate = 0.6;
  train.average_from = 0.6;
  train.epsilon = 1e-15;
  train.lazy_grids = true;
  train.reset_with_step = false;
  train.density_l1_weight = 0;
  train.density_l1_weight_later = 0;
  train.sparsity_weight = 1e-5;
  train.depth_weight = kDepthWeight;
  train.camera_moments = kCameraMoments;
  train.step_voxels = unbounded ? std::vector{24, 48, 96, 192} : std::vector{16, 32, 64, 128};
  train.step_moments = {0.03, 0.06, 0.1};
  train.step_ratio = 1;
  train.occupancy_resolution = 128;
  train.occupancy_moments = {};
  train.occupancy_interval = 16;
  train.occupancy_cells = 1 << 16;
  train.occupancy_threshold = 0.01;
  train.occupancy_decay = 0.6;
  train.occupancy_dilate = false;
  train.occupancy_min_views = 1;
  train.shrink_moments = {0.05, 0.1, 0.2};
  train.weight_threshold_first = unbounded ? 0.01 : 8e-3;
  train.weight_threshold_last = unbounded ? 0.01 : 4e-3;
  train.weight_threshold_moment = 0.5;
  return preset;
}

Preset TinyPreset(bool unbounded) {
  Preset preset = SmallPreset(unbounded);
  preset.field.levels = 5;
  preset.field.max_resolution = unbounded ? 128 : 64;
  preset.field.spatial_width = 32;
  preset.field.directional_width = 32;
  preset.field.bottleneck_width = 16;
  preset.train.steps = 2000;
  preset.train.rays = 512;
  preset.train.target_shaded = 2048;
  preset.train.step_voxels = unbounded ? std::vector{32, 64, 128} : std::vector{16, 32, 64};
  preset.train.step_moments = {0.1, 0.2};
  preset.train.shrink_moments = {0.3};
  preset.train.occupancy_resolution = 64;
  preset.train.occupancy_cells = 1 << 15;
  return preset;
}

}  // namespace

Preset MakePreset(const std::string& name, bool unbounded) {
  if (name == "paper") return {};
  if (name == "small") return SmallPreset(unbounded);
  if (name == "tiny") return TinyPreset(unbounded);
  std::string names;
  for (const char* known : kPresetNames) names += (names.empty() ? "" : ", ") + std::string(known);
  throw UsageError("--preset '" + name + "' is not known; the presets are " + names);
}

Decision FitDepths(Preset& preset, size_t n_depths, bool unbounded, std::optional<bool> forced) {
  if (forced.value_or(false) && n_depths == 0) {
    throw InputError("sparse depths are asked for, but the scene has none: its poses came without points");
  }
  double& weight = preset.train.depth_weight;
  Decision decision = needs::SparseDepth(n_depths, unbounded);
  if (decision.needed && weight == 0) {
    decision.needed = false;
    decision.reason = "the preset gives them no weight";
  }
  Force(decision, forced);
  weight = !decision.needed ? 0 : weight > 0 ? weight : kDepthWeight;
  return decision;
}

Decision FitCorrections(Preset& preset, const std::string& name, const Scene& scene, std::optional<bool> forced) {
  const std::vector<int> views = scene.ViewsOf(Split::kTrain);
  Decision decision = needs::ExposureCorrection(ExposureSpread(scene), scene.unbounded);
  if (name == "paper" && decision.needed) {
    decision.needed = false;
    decision.reason = "the preset keeps to the published method";
  }
  Force(decision, forced);
  preset.field.corrected_views = decision.needed ? int(views.size()) : 0;
  return decision;
}

void FitCameras(Preset& preset, std::optional<bool> forced) {
  TrainConfig& train = preset.train;
  if (!forced) return;
  if (*forced) {
    if (train.camera_moments.empty()) train.camera_moments = kCameraMoments;
    train.camera_least_px = 0;
  } else {
    train.camera_moments.clear();
  }
}

Decision FitLevelsToViews(Preset& preset, const std::string& name, int n_train_views, std::optional<bool> forced) {
  FieldConfig& field = preset.field;
  const bool sparse_depth = preset.train.depth_weight > 0;
  Decision decision = needs::FineLevels(n_train_views, sparse_depth, field.max_resolution);
  if (name == "paper" && !decision.needed) {
    decision.needed = true;
    decision.reason = "the preset keeps the published levels";
  }
  Force(decision, forced);
  if (decision.needed || field.max_resolution == field.base_resolution) return decision;
  // Forced where facts alone would keep all: what views without depths settle, but at least an octave less.
  const int settled = needs::FinestResolution(n_train_views, sparse_depth && !forced);
  const int wanted = std::max(field.base_resolution, std::min(settled, field.max_resolution / 2));
  // Levels keep their ratio: those that stay are as coarse as before.
  const double octaves = std::log2(double(field.max_resolution) / field.base_resolution);
  const double octaves_left = std::log2(double(wanted) / field.base_resolution);
  field.levels = std::max(1, 1 + int(std::lround((field.levels - 1) * octaves_left / octaves)));
  field.max_resolution = field.levels > 1 ? wanted : field.base_resolution;
  return decision;
}

}  // namespace nrff
