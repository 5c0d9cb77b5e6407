// What a model is (FieldConfig) and how it is trained (TrainConfig): numbers, presets, JSON.
//
// Presets:
//   paper   full size and schedule of the authors' code [Han23]: hours on a CPU
//   small   what two CPU cores train in a few minutes; the default
//   tiny    seconds; for tests and the example capture
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "model/kernels/shading_tile.h"
#include "pipeline/json.h"
#include "pipeline/needs.h"
#include "pipeline/scene.h"

namespace nrff {

// In the order of DirectionalEncoding.
inline constexpr const char* kDirectionalEncodings[] = {"ree", "ide", "pe", "none"};

struct FieldConfig {
  // Multiscale tensor decomposition (kernels/feature_grid.h).
  int levels = 16;
  int base_resolution = 16, max_resolution = 512;
  int finest_left_out = 0;  // of the levels, the others keep their resolutions; of fields in memory, in no file
  int density_channels = 2, appearance_channels = 4;  // per level, 2 or a multiple of 4
  double appearance_line_mean = 0;  // lines start at mean + 0.1·randn, planes and density lines at 0.1·randn
  // sigma = density_scale · softplus(f + density_shift), per unit of Samples::delta.
  double density_scale = 25, density_shift = -10;
  // Networks: `layers` counts linear layers. decoded_features: so many are made of the grid's features by one linear
  // layer before the spatial network, as in TensoRF [Chen22]; 0: the spatial network sees the grid's own.
  int decoded_features = 0;
  int spatial_layers = 3, spatial_width = 256;
  int bottleneck_width = 128;
  int lobes_theta = 8, lobes_phi = 16;  // kernels/ree.h
  int lobe_row_width = 16;  // features per row of lobes, from which a shared linear layer predicts a, λ, μ
  DirectionalEncoding directional_encoding = DirectionalEncoding::kRee;  // lobes and their rows: with kRee alone
  int directional_layers = 6, directional_width = 256;
  Activation activation = Activation::kGelu;
  // Training views whose colours have a correction of their own (render/kernels/colour_correction.h), in the order of
  // the scene's training views; 0: none.
  int corrected_views = 0;

  bool operator==(const FieldConfig&) const = default;
};

// Moments are fractions of the training, 0 to 1, so that a schedule fits any number of steps or seconds.
struct TrainConfig {
  int64_t steps = 30000;
  // Rays per step: `rays` at first; where target_shaded > 0 their number then follows it, so that about so many samples
  // are shaded per step, up to max_rays.
  int rays = 4096, max_rays = 4096;
  int64_t target_shaded = 0;

  // Adam (kernels/adam.h). Rates fall log-linearly, by final_rate over the whole training.
  double grid_rate = 0.02, network_rate = 1e-3, correction_rate = 1e-3, final_rate = 0.1;
  double beta1 = 0.9, beta2 = 0.99, epsilon = 1e-8;
  bool lazy_grids = false;
  // From this moment on the parameters are summed every average_interval steps, and the model is their mean: it lies
  // nearer to where training leads than any of them, and lets rates end high (stochastic weight averaging). 1: never.
  double average_from = 1;
  int average_interval = 16;
  bool reset_with_step = true;  // forget Adam's moments and start the fall of the rates anew when the step changes

  double orientation_weight = 0.3;
  double density_l1_weight = 8e-5;        // losses.h
  double density_l1_weight_later = 4e-5;  // from the first of shrink_moments on
  double sparsity_weight = 0;             // losses.h
  double depth_weight = 0;                // losses.h, on depth_rays rays through sparse points per step
  int depth_rays = 64;
  double correction_weight = 1e-3;  // losses.h, of fields with corrected_views

  // Cameras are corrected (camera_corrections.h) at these moments, by camera_pixels of each training view. At the first
  // they are looked at: where that would move pictures by less than camera_least_px, in the median of the views, they
  // stay as they are.
  std::vector<double> camera_moments = {};
  int camera_pixels = 200;  // fewer where there are many views
  double camera_least_px = needs::kVisibleDisplacement_px;

  // Marching step = step_ratio · (volume of the box)^(1/3) / step_voxels[i]; i grows at each of step_moments. The box
  // of an unbounded scene is that of contracted space, of side 4.
  std::vector<int> step_voxels = {128, 152, 180, 213, 253, 300};
  std::vector<double> step_moments = {2. / 30, 3. / 30, 4. / 30, 5.5 / 30, 7. / 30};
  double step_ratio = 0.5;

  // Occupancy grid (render/occupancy_grid.h). Either updated at occupancy_moments or every occupancy_interval steps;
  // before the first update every sample in the box is taken.
  int occupancy_resolution = 128;
  std::vector<double> occupancy_moments = {2. / 30, 4. / 30};
  int occupancy_interval = 0;
  int64_t occupancy_cells = 0;          // measured per update but the first, half of them among the occupied; 0: all
  double occupancy_threshold = 2.5e-4;  // opacity over a step; the authors' 1e-5 leaves density_scale (25) out
  double occupancy_decay = 0;
  bool occupancy_dilate = true;
  int occupancy_min_views = 0;                     // unbounded scenes: cells seen by fewer training views are empty
  std::vector<double> shrink_moments = {2. / 30};  // when the box of a bounded scene shrinks to what is occupied

  // Samples of less weight are not shaded. The threshold falls log-linearly until weight_threshold_moment; its last
  // value is also that of the trained model, which has learnt to show the scene without those samples.
  double weight_threshold_first = 1e-4, weight_threshold_last = 1e-4, weight_threshold_moment = 0;

  double unknown_background = 0.5;  // grey level behind everything where the scene names none
};

// At one moment.
struct LearningRates {
  double grid = 0, network = 0, correction = 0;
};

Json ToJson(const FieldConfig& config);
Json ToJson(const TrainConfig& config);
// Throws CorruptError naming `where` and the key on a missing key, a wrong type or an impossible value.
FieldConfig FieldConfigFromJson(const Json& json, const std::string& where);

struct Preset {
  FieldConfig field;
  TrainConfig train;
};

inline constexpr const char* kPresetNames[] = {"paper", "small", "tiny"};
// Not a preset: small, or under a budget what the first seconds show to fit (needs::SmallModel).
inline constexpr char kAutoPreset[] = "auto";

// Throws UsageError listing the presets when there is none of that name.
Preset MakePreset(const std::string& name, bool unbounded);

// Changes single values of a preset: "field.KEY=VALUE" and "train.KEY=VALUE", separated by blanks, VALUE as JSON
// without blanks. Throws UsageError naming the setting when there is no such key, or the value is of another type or
// impossible.
void ApplySettings(const std::string& settings, Preset& preset);

// Gives every training view a colour correction where needs::ExposureCorrection says so; says what was decided. `paper`
// keeps to the published method unless forced.
Decision FitCorrections(Preset& preset, const std::string& name, const Scene& scene, std::optional<bool> forced = {});

// Leaves out or forces the correction of cameras; `paper` corrects none unless forced. Whether a preset that may does
// is decided when cameras are first looked at (needs::CameraCorrection).
void FitCameras(Preset& preset, std::optional<bool> forced = {});

// Sets depth_weight to 0 where the depths are not needed, to a value where they are forced and the preset has none;
// says what was decided. Throws InputError when they are forced and there are none.
Decision FitDepths(Preset& preset, size_t n_depths, bool unbounded, std::optional<bool> forced = {});

// Leaves out the grid levels finer than so many training views can settle (needs::FinestResolution); says what was
// decided. `paper` keeps the published levels unless forced. To be called after FitDepths.
Decision FitLevelsToViews(Preset& preset, const std::string& name, int n_train_views, std::optional<bool> forced = {});

}  // namespace nrff
