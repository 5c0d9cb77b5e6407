// GpuTrainer by a StepProgram: queues steps, reads what they found, makes room.
#pragma once

#include <algorithm>
#include <cstring>
#include <deque>
#include <memory>
#include <vector>

#include "model/cuda/gpu_room.h"
#include "model/cuda/step_program.h"

namespace nrff::device {

template <typename Storage>
class GpuTrainerProgram : public GpuTrainer {
 public:
  GpuTrainerProgram(const GpuModel& model, const GpuScene& scene, int occupancy_resolution,
                    const GpuTrainerOptions& options)
      : model_(model),
        options_(options),
        program_(model, scene, occupancy_resolution, stream_.get()),
        average_(0),
        plan_(options.room),
        controls_(kSlots),
        results_(kSlots) {
    MakeRoom();
    stream_.Synchronize();  // the scene may go now
  }

  void SetState(const float* parameters, const float* m, const float* v, int64_t adam_t) override {
    const size_t n_bytes = Bytes();
    CopyToDevice(program_.parameters(), parameters, n_bytes, stream_.get());
    CopyToDevice(program_.m(), m, n_bytes, stream_.get());
    CopyToDevice(program_.v(), v, n_bytes, stream_.get());
    AdamState adam;
    adam.t = adam_t;
    CopyToDevice(program_.adam(), &adam, sizeof(adam), stream_.get());
    program_.QueueTables();
    stream_.Synchronize();
  }

  void GetState(float* parameters, float* m, float* v) override {
    CopyToHost(parameters, program_.parameters(), Bytes(), stream_.get());
    CopyToHost(m, program_.m(), Bytes(), stream_.get());
    CopyToHost(v, program_.v(), Bytes(), stream_.get());
    stream_.Synchronize();
  }

  void AddToAverage(int64_t n) override {
    if (average_.size() == 0) average_ = Buffer<float>(model_.n_parameters);
    if (n == 1) {
      Copy(average_.data(), program_.parameters(), Bytes(), stream_.get());
    } else {
      ForEach("average", model_.n_parameters, stream_.get(),
              AddToMean{program_.parameters(), 1 / static_cast<float>(n), average_.data()});
    }
  }
  void SetAverage(const float* average) override {
    if (average_.size() == 0) average_ = Buffer<float>(model_.n_parameters);
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

  std::vector<StepResult> Finish() override {
    std::vector<StepResult> results;
    while (n_read_ < n_queued_) results.push_back(Read());
    return results;
  }

  void Densities(const float* points, int64_t n, float* sigma) override {
    if (n == 0) return;
    if (density_points_.size() < 3 * n) {
      density_points_ = Buffer<float>(3 * n);
      density_sigma_ = Buffer<float>(n);
      density_count_ = Buffer<int64_t>(1);
    }
    CopyToDevice(density_points_.data(), points, static_cast<size_t>(3 * n) * sizeof(float), stream_.get());
    CopyToDevice(density_count_.data(), &n, sizeof(n), stream_.get());
    program_.QueueDensities(density_points_.data(), density_count_.data(), n, density_sigma_.data());
    CopyToHost(sigma, density_sigma_.data(), static_cast<size_t>(n) * sizeof(float), stream_.get());
    stream_.Synchronize();
  }

  // For tests: the gradient that the last step left [n_parameters].
  void GetGradient(float* gradient) {
    CopyToHost(gradient, program_.gradient(), Bytes(), stream_.get());
    stream_.Synchronize();
  }

  GpuRoom room() const override { return program_.room(); }
  int64_t most_rays() const override { return plan_.most_rays(); }
  size_t bytes() const override { return program_.BytesOf(program_.room()); }

 private:
  static constexpr int64_t kSlots = kLag + 1;

  size_t Bytes() const { return static_cast<size_t>(model_.n_parameters) * sizeof(float); }

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

}  // namespace nrff::device
