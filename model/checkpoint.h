// A training's state and its result on disk, as safetensors.
//
//   checkpoint.safetensors  everything a training goes on from: parameter/…, adam_m/…, adam_v/…, occupancy/…, and the
//                           numbers of TrainState as JSON under the metadata key "state"
//   model.safetensors       what rendering needs: parameter/…, occupancy/…, and under "model" as JSON: schema_version,
//                           field (FieldConfig), map (SceneMap), render (RenderOptions), cameras (CameraCorrections)
//
// Neither is ever written with a number that is not finite.
#pragma once

#include <filesystem>
#include <memory>
#include <string>

#include "model/nrff_field.h"
#include "model/train_state.h"
#include "render/occupancy_grid.h"
#include "render/scene_map.h"
#include "render/volume_renderer.h"

namespace nrff {

inline constexpr char kCheckpointFile[] = "checkpoint.safetensors";
inline constexpr char kModelFile[] = "model.safetensors";
inline constexpr int kModelSchemaVersion = 1;

// `settings`: text that must be equal for a training to go on from this checkpoint. Throws TrainingDiverged, and
// writes nothing, when a parameter is not finite.
void SaveCheckpoint(const std::filesystem::path& dir, const TrainState& state, const std::string& settings);

// Fills `state`, which was made with the same configuration. Throws CorruptError (and leaves `state` in part filled)
// when the file is damaged or was made with other settings.
void LoadCheckpoint(const std::filesystem::path& dir, const std::string& settings, TrainState& state);

void SaveModel(const std::filesystem::path& dir, const TrainState& state, const RenderOptions& options);

struct LoadedModel {
  std::unique_ptr<NrffField> field;
  OccupancyGrid occupancy;
  SceneMap map;
  RenderOptions options;
  CameraCorrections cameras;
};

// Throws InputError when there is no model in `dir`, CorruptError when it cannot be used.
std::unique_ptr<LoadedModel> LoadModel(const std::filesystem::path& dir);

}  // namespace nrff
