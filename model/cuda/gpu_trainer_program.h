// GpuTrainer by a StepProgram: queues steps, reads what they found, makes room.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "model/cuda/gpu_room.h"
#include "model/cuda/step_program.h"

namespace nrff::device {

template <typename Storage>
class GpuTrainerProgram : public GpuTrainer {
 public:
  GpuTrainerProgram(const GpuModel& model, const GpuScene& scene, int occupancy_resolution,
                    const GpuTrainerOptions& options)
      : model_(RequireRoom(model, scene, options)),
        options_(options),
        program_(model, scene, occupancy_resolution, options.trains, stream_.get()),
        average_(0),
        plan_(options.room),
        controls_(kSlots),
        results_(kSlots) {
    if (options.trains) {  // now, as a step's memory takes what there is
      average_ = Buffer<float>(model.n_parameters);
      density_points_ = Buffer<float>(3 * kDensityPoints);
      density_sigma_ = Buffer<float>(kDensityPoints);
      density_count_ = Buffer<int64_t>(1);
    }
    MakeRoom();
    stream_.Synchronize();  // the scene may go now
  }

  ~GpuTrainerProgram() override {
    try {
      stream_.Synchronize();  // what is queued works in memory that goes now
    } catch (const DeviceError&) {
      // The error has been seen, or nothing is asked any more.
    }
  }

  void SetParameters(const float* parameters) override {
    CopyToDevice(program_.parameters(), parameters, Bytes(), stream_.get());
    program_.QueueTables();
    stream_.Synchronize();
  }

  void SetMoments(const float* m, const float* v, int64_t adam_t) override {
    CopyToDevice(program_.m(), m, Bytes(), stream_.get());
    CopyToDevice(program_.v(), v, Bytes(), stream_.get());
    AdamState adam;
    adam.t = adam_t;
    CopyToDevice(program_.adam(), &adam, sizeof(adam), stream_.get());
    stream_.Synchronize();
  }

  void GetState(float* parameters, float* m, float* v) override {
    CopyToHost(parameters, program_.parameters(), Bytes(), stream_.get());
    CopyToHost(m, program_.m(), Bytes(), stream_.get());
    CopyToHost(v, program_.v(), Bytes(), stream_.get());
    stream_.Synchronize();
  }

  void AddToAverage(int64_t n) override {
    if (n == 1) {
      Copy(average_.data(), program_.parameters(), Bytes(), stream_.get());
    } else {
      ForEach("average", model_.n_parameters, stream_.get(),
              AddToMean{program_.parameters(), 1 / static_cast<float>(n), average_.data()});
    }
  }
  void SetAverage(const float* average) override {
    CopyToDevice(average_.data(), average, Bytes(), stream_.get());
    stream_.Synchronize();
  }
  void GetAverage(float* average) override {
    CopyToHost(average, average_.data(), Bytes(), stream_.get());
    stream_.Synchronize();
  }

  void SetOccupancy(const OccupancyBits& bits) override {
    program_.SetOccupancy(bits);
    stream_.Synchronize();
  }

  void SetViews(const std::vector<GpuView>& views) override {
    program_.SetViews(views);
    stream_.Synchronize();
  }

  std::optional<StepResult> Step(const StepControl& control) override {
    std::optional<StepResult> result;
    if (n_queued_ - n_read_ == kLag) result = Read();
    if (!program_.has_room() || !(program_.room() == plan_.room())) MakeRoom();
    const int64_t slot = n_queued_ % kSlots;
    StepControl& queued = controls_[slot];
    queued = control;
    queued.n_depths = std::min(queued.n_depths, program_.room().rays / 2);
    queued.n_rays = std::min(queued.n_rays, program_.room().rays - queued.n_depths);
    CopyToDevice(program_.control(), &queued, sizeof(queued), stream_.get());
    if (!options_.use_graph) {
      program_.QueueStep();
    } else if (graph_.captured()) {
      graph_.Launch(stream_.get());
    } else if (!warm_) {
      program_.QueueStep();  // products find their algorithms
      warm_ = true;
    } else {
      graph_.Capture(stream_.get(), [this] { program_.QueueStep(); });
      graph_.Launch(stream_.get());
    }
    CopyToHost(&results_[slot], program_.result(), sizeof(StepResult), stream_.get());
    marks_[slot].Record(stream_.get());
    rooms_[slot] = program_.room();
    ++n_queued_;
    return result;
  }

  std::map<std::string, double> Profile(const StepControl& control, int n) override {
    const bool use_graph = std::exchange(options_.use_graph, false);
    StartProfile();
    for (int i = 0; i < n; ++i) Step(control);
    Finish();
    std::map<std::string, double> milliseconds;
    for (const auto& [what, work] : EndProfile()) milliseconds[what] = work.milliseconds / n;
    options_.use_graph = use_graph;
    return milliseconds;
  }

  std::vector<StepResult> Finish() override {
    std::vector<StepResult> results;
    while (n_read_ < n_queued_) results.push_back(Read());
    return results;
  }

  void Densities(const float* points, int64_t n, float* sigma) override {
    for (int64_t first = 0; first < n; first += kDensityPoints) {
      const int64_t n_part = std::min(kDensityPoints, n - first);
      CopyToDevice(density_points_.data(), points + 3 * first, static_cast<size_t>(3 * n_part) * sizeof(float),
                   stream_.get());
      CopyToDevice(density_count_.data(), &n_part, sizeof(n_part), stream_.get());
      program_.QueueDensities(density_points_.data(), density_count_.data(), n_part, density_sigma_.data());
      CopyToHost(sigma + first, density_sigma_.data(), static_cast<size_t>(n_part) * sizeof(float), stream_.get());
      stream_.Synchronize();
    }
  }

  std::array<int64_t, 2> Render(const GpuRays& rays, const StepControl& control, const GpuPicture& picture) override {
    if (!program_.has_room()) MakeRoom();
    program_.QueuePackWeights();
    std::array<int64_t, 2> evaluated{};
    int64_t at_once = program_.room().rays;
    for (int64_t first = 0; first < rays.n;) {
      const int64_t n = std::min(at_once, rays.n - first);
      if (RenderSome(rays, first, n, control, picture, evaluated)) {
        first += n;
        at_once = std::min(program_.room().rays, 2 * n);
      } else if (n == 1) {
        throw DeviceError("a ray of the picture has more samples than there is room for on the GPU");
      } else {
        at_once = n / 2;
      }
    }
    return evaluated;
  }

  size_t bytes() const override { return program_.BytesOf(program_.room()); }

 private:
  static constexpr int64_t kSlots = kLag + 1;
  static constexpr int64_t kDensityPoints = int64_t{1} << 18;

  // Before anything is allocated: whether the model, the photos and a step of the fewest rays fit.
  static const GpuModel& RequireRoom(const GpuModel& model, const GpuScene& scene, const GpuTrainerOptions& options) {
    const size_t others = (size_t{1} << 20) + Matmul::WorkspaceBytes() + scene.depths.size() * sizeof(DepthTarget) +
                          4 * kDensityPoints * sizeof(float);  // and cameras, occupancy grid
    GpuRoomPlan least(options.room);
    while (least.Halve()) {
    }
    const size_t free = GetDeviceFacts().free_bytes;
    const size_t of_model = StepProgram<Storage>::BytesOf(model, options.trains);
    const size_t of_step = StepProgram<Storage>::BytesOf(model, least.room(), options.trains);
    const size_t without_photos = of_model + of_step + others, needed = without_photos + scene.pack_bytes;
    if (needed <= free) return model;
    const auto mebibytes = [](size_t bytes) { return std::to_string((bytes >> 20) + 1) + " MiB"; };
    std::string text = mebibytes(needed) + " of GPU memory are needed at the least (" + mebibytes(of_model) +
                       " for the model, " + mebibytes(scene.pack_bytes) + " for photos, " + mebibytes(of_step) +
                       " for a step), and " + mebibytes(free) + " are free; ";
    if (without_photos < free && scene.pack_bytes > 0) {
      const auto share = static_cast<double>(free - without_photos) / static_cast<double>(scene.pack_bytes);
      text += "photos of " + std::to_string(static_cast<int>(100 * std::sqrt(share))) + " % of their size would fit";
    } else {
      text += "the model does not fit";
    }
    throw DeviceError(text);
  }

  size_t Bytes() const { return static_cast<size_t>(model_.n_parameters) * sizeof(float); }

  // False, with nothing done, when there is no room for so many rays.
  bool RenderSome(const GpuRays& rays, int64_t first, int64_t n, const StepControl& control, const GpuPicture& picture,
                  std::array<int64_t, 2>& evaluated) {
    constexpr int64_t kRows = 1024;  // rows of the networks come in multiples of it, so that shapes of products repeat
    StepControl of_part = control;
    of_part.n_rays = n;
    of_part.n_depths = 0;
    of_part.jitter = false;
    CopyToDevice(program_.control(), &of_part, sizeof(of_part), stream_.get());
    program_.QueuePictureRays(rays, first, n);
    if (ReadNow().n_samples > program_.room().samples) return false;
    program_.QueuePictureWeights();
    const StepResult found = ReadNow();
    if (found.n_shaded > program_.room().shaded) return false;
    const int64_t rows = std::min(program_.room().shaded, (found.n_shaded + kRows - 1) / kRows * kRows);
    program_.QueuePictureColours(rows, first, n, picture);
    stream_.Synchronize();
    evaluated[0] += found.n_samples;
    evaluated[1] += found.n_shaded;
    return true;
  }

  StepResult ReadNow() {
    StepResult result;
    CopyToHost(&result, program_.result(), sizeof(result), stream_.get());
    stream_.Synchronize();
    return result;
  }

  StepResult Read() {
    const int64_t slot = n_read_ % kSlots;
    marks_[slot].Wait();
    ++n_read_;
    plan_.Observe(rooms_[slot], results_[slot].n_samples, results_[slot].n_shaded);
    return results_[slot];
  }

  // Halves what a step holds until there is memory for it.
  void MakeRoom() {
    stream_.Synchronize();  // what is queued works in the present memory
    graph_ = {};
    warm_ = false;
    while (true) {
      try {
        program_.MakeRoom(plan_.room());
        return;
      } catch (const OutOfDeviceMemory&) {
        if (!plan_.Halve()) throw;
      }
    }
  }

  GpuModel model_;
  GpuTrainerOptions options_;
  Stream stream_;
  StepProgram<Storage> program_;
  Buffer<float> average_;
  GpuRoomPlan plan_;
  PinnedBuffer<StepControl> controls_;
  PinnedBuffer<StepResult> results_;
  Mark marks_[kSlots];
  GpuRoom rooms_[kSlots];
  int64_t n_queued_ = 0, n_read_ = 0;
  bool warm_ = false;
  Graph graph_;
  Buffer<float> density_points_, density_sigma_;
  Buffer<int64_t> density_count_;
};

inline std::unique_ptr<GpuTrainer> MakeGpuTrainerProgram(const GpuModel& model, const GpuScene& scene,
                                                         int occupancy_resolution, const GpuTrainerOptions& options) {
  if (options.precision == GpuPrecision::kFloat) {
    return std::make_unique<GpuTrainerProgram<FloatStorage>>(model, scene, occupancy_resolution, options);
  }
  return std::make_unique<GpuTrainerProgram<HalfStorage>>(model, scene, occupancy_resolution, options);
}

}  // namespace nrff::device
