#include "model/cuda/gpu_room.h"

#include <algorithm>

namespace nrff {
namespace {

constexpr double kMargin = 1.2;      // over the most that was seen
constexpr double kTooMuch = 1.6;     // room beyond so many times the most that was seen is given back
constexpr int kWindow = 512;         // steps
constexpr int64_t kMultiple = 4096;  // samples; sizes that change rarely let graphs be used again
constexpr int64_t kFewestRays = 64;

int64_t RoundUp(int64_t n) { return std::max(kMultiple, (n + kMultiple - 1) / kMultiple * kMultiple); }
int64_t RoomFor(int64_t n) { return RoundUp(static_cast<int64_t>(kMargin * static_cast<double>(n))); }

}  // namespace

GpuRoomPlan::GpuRoomPlan(const GpuRoom& room)
    : room_{room.rays, RoundUp(room.samples), RoundUp(room.shaded)}, most_rays_(room.rays) {}

bool GpuRoomPlan::Observe(const GpuRoom& had, int64_t n_samples, int64_t n_shaded) {
  const GpuRoom before = room_;
  if (had.rays > room_.rays) {  // of a step before the rays were halved
    n_samples = n_samples * room_.rays / had.rays;
    n_shaded = n_shaded * room_.rays / had.rays;
  }
  if (n_samples > had.samples) room_.samples = std::max(room_.samples, RoomFor(n_samples));
  // With too little room for samples their weights were not all seen.
  if (n_shaded > had.shaded) room_.shaded = std::max(room_.shaded, RoomFor(n_shaded));
  most_samples_ = std::max(most_samples_, n_samples);
  most_shaded_ = std::max(most_shaded_, n_shaded);
  if (++n_observed_ >= kWindow) {
    const auto fit = [](int64_t room, int64_t most) {
      return static_cast<double>(room) > kTooMuch * static_cast<double>(RoomFor(most)) ? RoomFor(most) : room;
    };
    room_.samples = fit(room_.samples, most_samples_);
    room_.shaded = fit(room_.shaded, most_shaded_);
    n_observed_ = 0;
    most_samples_ = most_shaded_ = 0;
  }
  return !(room_ == before);
}

bool GpuRoomPlan::Halve() {
  if (most_rays_ <= kFewestRays) return false;
  most_rays_ = std::max(kFewestRays, most_rays_ / 2);
  room_ = {most_rays_, RoundUp(room_.samples / 2), RoundUp(room_.shaded / 2)};
  return true;
}

}  // namespace nrff
