// Training and rendering of the NRFF model on a GPU, as what uses it sees it: plain memory, no CUDA, no torch.
//
// A step is a fixed sequence of kernels over memory that was laid out before (step_program.h); nothing of it waits for
// the host. What a step found comes back kLag steps later.
#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "model/kernels/activation.h"
#include "model/kernels/directional_encoding.h"
#include "model/kernels/feature_grid.h"
#include "model/kernels/ree.h"
#include "render/kernels/depth_ray.h"
#include "render/kernels/occupancy_bits.h"
#include "render/kernels/step_control.h"

namespace nrff {

// A model's shape. Its parameters lie in one array: the density grid, the appearance grid, then the layers' weights
// [n_out, n_in] and biases, then the views' colour corrections; each begins at a multiple of 64 elements, with zeros
// between.
struct GpuModel {
  struct Layer {
    int n_in = 0, n_out = 0;
    int64_t weight = 0, bias = 0;  // where they begin
  };
  struct Segment {
    int64_t begin = 0, n = 0;
  };
  GridLayout density, appearance;
  float density_scale = 1, density_shift = 0;
  std::vector<Layer> spatial, directional;
  bool decodes = false;                                      // the first spatial layer is followed by no activation
  DirectionalEncoding encoding = DirectionalEncoding::kRee;  // or kNone; a GPU has no others
  Layer lobe_layer;                                          // with kRee
  Lobes lobes;
  int bottleneck_width = 0;
  Activation activation = Activation::kGelu;
  int corrected_views = 0;

  std::vector<Segment> segments;  // of the parameters, in the order of NrffField::parameters()
  int64_t n_grid = 0;             // elements of the grids, what lies between included
  int64_t corrections = 0;        // where they begin; n_parameters where there are none
  int64_t n_parameters = 0;       // all elements
};

// What is learnt from. Copied to the device.
struct GpuScene {
  std::vector<device::GpuView> views;
  std::vector<uint64_t> pixels_before;  // [n_views + 1]
  std::vector<uint32_t> rows_before;    // PixelSource's
  const uint8_t* pack = nullptr;
  size_t pack_bytes = 0;
  std::vector<DepthTarget> depths;
};

// How much a step may hold.
struct GpuRoom {
  int64_t rays = 0, samples = 0, shaded = 0;
  bool operator==(const GpuRoom&) const = default;
};

// Rays of pictures: through the pixels of a view `width` wide, row by row from `first`; or, where origins is not null,
// those given in the host's memory.
struct GpuRays {
  int64_t n = 0;
  PinholeCamera camera;
  int width = 0;
  int64_t first = 0;
  const float *origins = nullptr, *directions = nullptr;  // [n, 3]
};

// What rays show; in the host's memory. render/image_renderer.h, before depths and normals are normalised.
struct GpuPicture {
  float *rgb = nullptr, *depth = nullptr, *normal = nullptr, *opacity = nullptr;  // [n, 3], [n], [n, 3], [n]
};

enum class GpuPrecision { kFloat, kHalf };  // kHalf: bf16 networks, tables of halfs; parameters stay float

class GpuTrainer {
 public:
  virtual ~GpuTrainer() = default;

  // parameters, m, v [model.n_parameters].
  virtual void SetParameters(const float* parameters) = 0;
  virtual void SetMoments(const float* m, const float* v, int64_t adam_t) = 0;
  // Waits for the steps queued so far.
  virtual void GetState(float* parameters, float* m, float* v) = 0;
  // The mean of the parameters: one more value into it, the n-th; and the mean itself [n_parameters], which waits.
  virtual void AddToAverage(int64_t n) = 0;
  virtual void SetAverage(const float* average) = 0;
  virtual void GetAverage(float* average) = 0;

  virtual void SetOccupancy(const OccupancyBits& bits) = 0;
  // As many as the scene has: the same pictures, seen from elsewhere. Waits.
  virtual void SetViews(const std::vector<device::GpuView>& views) = 0;

  // Queues a step, with as many of the control's rays as there is memory for. Returns what the step kLag before it
  // found; that of a step whose samples found no room, and which changed nothing, has no had_room, and more room is
  // made for the following.
  static constexpr int kLag = 4;
  virtual std::optional<device::StepResult> Step(const device::StepControl& control) = 0;
  // Milliseconds of each kind of work of a step, the mean of n steps that are queued one piece of work at a time.
  virtual std::map<std::string, double> Profile(const device::StepControl& control, int n) = 0;
  // Waits; what the steps since found.
  virtual std::vector<device::StepResult> Finish() = 0;

  // σ of points [n, 3]; both in the host's memory. Waits.
  virtual void Densities(const float* points, int64_t n, float* sigma) = 0;

  // The control's rays are n_rays of `rays`, without jitter. Waits; returns {evaluations of density, of shading}.
  // Throws device::DeviceError when a single ray has more samples than there is room for.
  virtual std::array<int64_t, 2> Render(const GpuRays& rays, const device::StepControl& control,
                                        const GpuPicture& picture) = 0;

  virtual size_t bytes() const = 0;  // of the device's memory, that a step takes
};

struct GpuTrainerOptions {
  GpuPrecision precision = GpuPrecision::kHalf;
  GpuRoom room;           // to begin with
  bool use_graph = true;  // a step is queued as one graph
  bool trains = true;     // or makes pictures alone, in less memory: with SetParameters, SetOccupancy and Render
};

}  // namespace nrff
