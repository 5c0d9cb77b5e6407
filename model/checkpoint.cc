#include "model/checkpoint.h"

#include <ATen/ATen.h>
#include <c10/core/GradMode.h>

#include <algorithm>

#include "model/base_training.h"
#include "model/kernels/adam.h"
#include "model/safetensors.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"

namespace nrff {

NLOHMANN_DEFINE_TYPE_NON_INTRUSIVE(CurvePoint, seconds, steps, samples, psnr, train_psnr)
NLOHMANN_DEFINE_TYPE_NON_INTRUSIVE(SceneMap, unbounded, center, half_extent)

namespace {

using torch::Tensor;

constexpr char kParameterPrefix[] = "parameter/";
constexpr char kAdamMPrefix[] = "adam_m/";
constexpr char kAdamVPrefix[] = "adam_v/", kAveragePrefix[] = "average/";

constexpr char kCorrectionsName[] = "colour_corrections";  // NrffField's

// TrainState's plain numbers by name. `Visit` is called with (name, member) for each: the one list for both directions.
template <typename State, typename Visit>
void ForEachNumber(State& state, const Visit& visit) {
  visit("adam_t", state.adam_t);
  visit("n_averaged", state.n_averaged);
  visit("map", state.map);
  visit("step", state.step);
  visit("n_rays", state.n_rays);
  visit("samples", state.samples);
  visit("seconds", state.seconds);
  visit("progress_at_reset", state.progress_at_reset);
  visit("step_stage", state.step_stage);
  visit("occupancy_updates", state.occupancy_updates);
  visit("occupancy_moments_done", state.occupancy_moments_done);
  visit("shrink_moments_done", state.shrink_moments_done);
  visit("cameras", state.cameras);
  visit("camera_displacements_px", state.camera_displacements_px);
  visit("camera_first_px", state.camera_first_px);
  visit("camera_moments_done", state.camera_moments_done);
  visit("n_skipped", state.n_skipped);
  visit("n_skipped_in_row", state.n_skipped_in_row);
  visit("rate_scale", state.rate_scale);
  visit("rollbacks", state.rollbacks);
  visit("train_mse", state.train_mse);
  visit("evaluations", state.evaluations);
  visit("curve", state.curve);
  visit("seconds_evaluating", state.seconds_evaluating);
  visit("resumed", state.resumed);
}

class Writer {
 public:
  void Add(const std::string& name, const Tensor& tensor) {
    if (!AllFinite(tensor.const_data_ptr<float>(), tensor.numel())) {
      throw TrainingDiverged("training left a number that is not finite in " + name);
    }
    tensors_.push_back({name, DType::kF32, tensor.sizes().vec(), tensor.const_data_ptr<float>()});
  }
  void Add(const NrffField& field) {
    for (const NrffField::Parameter& parameter : field.parameters())
      Add(kParameterPrefix + parameter.name, parameter.value);
  }
  void Add(const OccupancyGrid::State& occupancy) {
    const auto n_words = int64_t(occupancy.seen.size());
    tensors_.push_back(
        {"occupancy/opacity", DType::kF32, {int64_t(occupancy.opacity.size())}, occupancy.opacity.data()});
    tensors_.push_back({"occupancy/seen", DType::kI64, {n_words}, occupancy.seen.data()});
    tensors_.push_back({"occupancy/occupied", DType::kI64, {n_words}, occupancy.occupied.data()});
    tensors_.push_back({"occupancy/resolution", DType::kI64, {1}, &(resolution_ = occupancy.resolution)});
  }
  void Write(const std::filesystem::path& path, const std::map<std::string, std::string>& metadata) {
    WriteSafetensors(path, std::move(tensors_), metadata);
  }

 private:
  std::vector<TensorToWrite> tensors_;
  int64_t resolution_ = 0;
};

void Read(const SafetensorsFile& file, const std::string& name, const Tensor& tensor) {
  const std::vector<float> values = file.Values<float>(name, tensor.sizes().vec());
  if (!AllFinite(values.data(), int64_t(values.size()))) {
    throw CorruptError(EscapePath(file.path()) + ": tensor '" + name + "' holds numbers that are not finite");
  }
  std::copy(values.begin(), values.end(), tensor.mutable_data_ptr<float>());
}

void Read(const SafetensorsFile& file, const NrffField& field) {
  const c10::NoGradGuard no_grad;
  for (const NrffField::Parameter& parameter : field.parameters()) {
    Read(file, kParameterPrefix + parameter.name, parameter.value);
  }
}

OccupancyGrid ReadOccupancy(const SafetensorsFile& file) {
  OccupancyGrid::State state;
  const auto words = [&](const char* name) {
    const std::vector<int64_t> values = file.Values<int64_t>(name);
    return std::vector<uint64_t>(values.begin(), values.end());
  };
  state.resolution = int(file.Values<int64_t>("occupancy/resolution", {1})[0]);
  state.opacity = file.Values<float>("occupancy/opacity");
  state.seen = words("occupancy/seen");
  state.occupied = words("occupancy/occupied");
  return OccupancyGrid::FromState(std::move(state));
}

Json ParseMetadata(const SafetensorsFile& file, const char* key) {
  try {
    return ParseJson(file.Metadata(key));
  } catch (const JsonSyntaxError& error) {
    throw CorruptError(EscapePath(file.path()) + ": the metadata '" + key + "' is not JSON (" + error.what() + ")");
  }
}

}  // namespace

void SaveCheckpoint(const std::filesystem::path& dir, const TrainState& state, const std::string& settings) {
  Writer writer;
  writer.Add(state.field);
  const auto& parameters = state.field.parameters();
  for (size_t i = 0; i < parameters.size(); ++i) {
    writer.Add(kAdamMPrefix + parameters[i].name, state.adam_m[i]);
    writer.Add(kAdamVPrefix + parameters[i].name, state.adam_v[i]);
    if (state.n_averaged > 0) writer.Add(kAveragePrefix + parameters[i].name, state.average[i]);
  }
  const OccupancyGrid::State occupancy = state.occupancy.GetState();
  writer.Add(occupancy);
  Json numbers = Json::object();
  ForEachNumber(state, [&](const char* name, const auto& value) { numbers[name] = value; });
  writer.Write(dir / kCheckpointFile, {{"state", numbers.dump()}, {"settings", settings}});
}

void LoadCheckpoint(const std::filesystem::path& dir, const std::string& settings, TrainState& state) {
  const SafetensorsFile file(dir / kCheckpointFile);
  const std::string where = EscapePath(file.path());
  if (file.Metadata("settings") != settings) throw CorruptError(where + " was made with other settings");
  Read(file, state.field);
  const auto& parameters = state.field.parameters();
  for (size_t i = 0; i < parameters.size(); ++i) {
    Read(file, kAdamMPrefix + parameters[i].name, state.adam_m[i]);
    Read(file, kAdamVPrefix + parameters[i].name, state.adam_v[i]);
  }
  state.occupancy = ReadOccupancy(file);
  const Json numbers = ParseMetadata(file, "state");
  ForEachNumber(state, [&](const char* name, auto& value) {
    value = Get<std::remove_reference_t<decltype(value)>>(numbers, name, where);
  });
  state.average.clear();
  for (size_t i = 0; state.n_averaged > 0 && i < parameters.size(); ++i) {
    state.average.push_back(at::empty(parameters[i].value.sizes(), torch::kFloat));
    Read(file, kAveragePrefix + parameters[i].name, state.average.back());
  }
}

BaseTraining ReadBaseTraining(const std::filesystem::path& dir) {
  const SafetensorsFile file(dir / kCheckpointFile);
  BaseTraining base;
  base.settings = file.Metadata("settings");
  const Json numbers = ParseMetadata(file, "state");
  const std::string where = EscapePath(file.path());
  base.steps = Get<int64_t>(numbers, "step", where);
  const bool averaged = Get<int64_t>(numbers, "n_averaged", where) > 0;
  const std::string corrections = std::string(averaged ? kAveragePrefix : kParameterPrefix) + kCorrectionsName;
  if (file.Has(corrections)) base.corrections = file.Values<float>(corrections);
  return base;
}

void LoadBase(const std::filesystem::path& dir, TrainState& state) {
  const c10::NoGradGuard no_grad;
  const SafetensorsFile file(dir / kCheckpointFile);
  const std::string where = EscapePath(file.path());
  const Json numbers = ParseMetadata(file, "state");
  const auto number = [&](const char* name, auto& value) {
    value = Get<std::remove_reference_t<decltype(value)>>(numbers, name, where);
  };
  int64_t n_averaged = 0;
  number("n_averaged", n_averaged);
  const auto& parameters = state.field.parameters();
  for (size_t i = 0; i < parameters.size(); ++i) {
    if (parameters[i].name == kCorrectionsName) continue;
    Read(file, (n_averaged > 0 ? kAveragePrefix : kParameterPrefix) + parameters[i].name, parameters[i].value);
    Read(file, kAdamMPrefix + parameters[i].name, state.adam_m[i]);
    Read(file, kAdamVPrefix + parameters[i].name, state.adam_v[i]);
  }
  number("adam_t", state.adam_t);
  number("map", state.map);
  number("n_rays", state.n_rays);
  number("progress_at_reset", state.progress_at_reset);
  number("step_stage", state.step_stage);
  number("occupancy_updates", state.occupancy_updates);
  number("occupancy_moments_done", state.occupancy_moments_done);
  number("shrink_moments_done", state.shrink_moments_done);
  number("rate_scale", state.rate_scale);
  number("train_mse", state.train_mse);
  number("cameras", state.cameras);
  number("camera_first_px", state.camera_first_px);
  OccupancyGrid::State occupancy = ReadOccupancy(file).GetState();
  // In bounded scenes, whose box may have shrunk, every cell is seen.
  if (state.map.unbounded) {
    const OccupancyGrid::State now = state.occupancy.GetState();
    if (now.resolution != occupancy.resolution) throw CorruptError(where + " has another occupancy grid");
    for (size_t w = 0; w < now.seen.size(); ++w) {
      const uint64_t added = now.seen[w] & ~occupancy.seen[w];
      occupancy.occupied[w] = (occupancy.occupied[w] | added) & now.seen[w];
    }
    occupancy.seen = now.seen;
  }
  state.occupancy = OccupancyGrid::FromState(std::move(occupancy));
}

void SaveModel(const std::filesystem::path& dir, const TrainState& state, const RenderOptions& options) {
  Writer writer;
  writer.Add(state.field);
  const OccupancyGrid::State occupancy = state.occupancy.GetState();
  writer.Add(occupancy);
  const Json model = {{"schema_version", kModelSchemaVersion},
                      {"field", ToJson(state.field.config())},
                      {"map", state.map},
                      {"cameras", state.cameras},
                      {"render",
                       {{"step", options.step},
                        {"near", options.near},
                        {"far", options.far},
                        {"weight_threshold", options.weight_threshold},
                        {"stop_transmittance", options.stop_transmittance},
                        {"background", options.background}}}};
  writer.Write(dir / kModelFile, {{"model", model.dump()}});
}

std::unique_ptr<LoadedModel> LoadModel(const std::filesystem::path& dir) {
  const SafetensorsFile file(dir / kModelFile);
  const std::string where = EscapePath(file.path());
  const Json json = ParseMetadata(file, "model");
  CheckSchemaVersion(json, kModelSchemaVersion, where);
  const FieldConfig config = FieldConfigFromJson(Get<Json>(json, "field", where), where);
  const Json render = Get<Json>(json, "render", where);
  RenderOptions options;
  options.step = Get<double>(render, "step", where);
  options.near = Get<double>(render, "near", where);
  options.far = Get<double>(render, "far", where);
  options.weight_threshold = Get<double>(render, "weight_threshold", where);
  options.stop_transmittance = Get<double>(render, "stop_transmittance", where);
  options.background = Get<double>(render, "background", where);
  auto model = std::make_unique<LoadedModel>(LoadedModel{std::make_unique<NrffField>(config, torch::kFloat, 0),
                                                         ReadOccupancy(file),
                                                         Get<SceneMap>(json, "map", where),
                                                         options,
                                                         {}});
  if (json.contains("cameras"))
    model->cameras = Get<CameraCorrections>(json, "cameras", where);  // models of old lack them
  Read(file, *model->field);
  return model;
}

}  // namespace nrff
