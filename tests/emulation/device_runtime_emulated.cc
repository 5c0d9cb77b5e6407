// The emulation of device_runtime.h on the CPU, for tests. Device memory is ordinary memory; work is done when it is
// queued, unless a graph is captured.

#include <algorithm>
#include <chrono>
#include <cstdlib>
#include <cstring>
#include <map>
#include <mutex>
#include <vector>

#include "render/kernels/device_runtime.h"
#include "tests/emulation/device_emulation.h"

namespace nrff::device {
namespace {

using Work = std::function<void()>;

struct Device {
  std::mutex mutex;
  std::map<const char*, size_t> allocations, pinned;  // begin → bytes
  size_t used = 0, capacity = size_t{1} << 40, most_used = 0;
  std::vector<Work>* capture = nullptr;
};
Device& TheDevice() {
  static Device device;
  return device;
}

void RefuseInCapture(const char* what) {
  if (TheDevice().capture != nullptr) throw DeviceError(std::string(what) + " while a graph is captured");
}

void Queue(Work work) {
  if (std::vector<Work>* capture = TheDevice().capture; capture != nullptr) {
    capture->push_back(std::move(work));
  } else {
    work();
  }
}

bool Holds(const std::map<const char*, size_t>& blocks, const void* memory, size_t bytes) {
  const auto* begin = static_cast<const char*>(memory);
  auto after = blocks.upper_bound(begin);
  if (after == blocks.begin()) return false;
  --after;
  return begin + bytes <= after->first + after->second;
}

// Mixing up the two memories is an error on a GPU, too.
void RequireDevice(const void* memory, size_t bytes) {
  Device& device = TheDevice();
  const std::lock_guard lock(device.mutex);
  if (bytes > 0 && !Holds(device.allocations, memory, bytes)) throw DeviceError("not memory of the device");
}
void RequireHost(const void* memory, size_t bytes) {
  Device& device = TheDevice();
  const std::lock_guard lock(device.mutex);
  if (bytes == 0) return;
  if (Holds(device.allocations, memory, 1)) throw DeviceError("memory of the device given as the host's");
  if (device.capture != nullptr && !Holds(device.pinned, memory, bytes)) {
    throw DeviceError("a copy of host memory that is not pinned while a graph is captured");
  }
}

void* AllocateIn(std::map<const char*, size_t>& blocks, size_t bytes) {
  constexpr size_t kAlignment = 256;
  const size_t rounded = (std::max<size_t>(bytes, 1) + kAlignment - 1) / kAlignment * kAlignment;
  void* memory = std::aligned_alloc(kAlignment, rounded);
  if (memory == nullptr) throw OutOfDeviceMemory(bytes, 0);
  std::memset(memory, 0xff, rounded);  // NaN in every format of a number
  blocks[static_cast<const char*>(memory)] = bytes;
  return memory;
}

}  // namespace

OutOfDeviceMemory::OutOfDeviceMemory(size_t asked_bytes, size_t free_bytes)
    : DeviceError("out of GPU memory: " + std::to_string(asked_bytes >> 20) + " MiB were asked for, " +
                  std::to_string(free_bytes >> 20) + " MiB are free"),
      asked(asked_bytes),
      free(free_bytes) {}

void SetEmulatedMemory(size_t bytes) {
  TheDevice().capacity = bytes;
  TheDevice().most_used = TheDevice().used;
}
size_t MostEmulatedMemoryUsed() { return TheDevice().most_used; }

DeviceFacts GetDeviceFacts() {
  const Device& device = TheDevice();
  return {"emulated on the CPU", 0, device.capacity, device.capacity - std::min(device.capacity, device.used)};
}

void* Allocate(size_t bytes) {
  RefuseInCapture("memory is allocated");
  Device& device = TheDevice();
  const std::lock_guard lock(device.mutex);
  const size_t free = device.capacity - std::min(device.capacity, device.used);
  if (bytes > free) throw OutOfDeviceMemory(bytes, free);
  void* memory = AllocateIn(device.allocations, bytes);
  device.used += bytes;
  device.most_used = std::max(device.most_used, device.used);
  return memory;
}

void Free(void* memory) noexcept {
  if (memory == nullptr) return;
  Device& device = TheDevice();
  const std::lock_guard lock(device.mutex);
  const auto found = device.allocations.find(static_cast<const char*>(memory));
  device.used -= found->second;
  device.allocations.erase(found);
  std::free(memory);
}

void* AllocatePinned(size_t bytes) {
  Device& device = TheDevice();
  const std::lock_guard lock(device.mutex);
  return AllocateIn(device.pinned, bytes);
}

void FreePinned(void* memory) noexcept {
  if (memory == nullptr) return;
  Device& device = TheDevice();
  const std::lock_guard lock(device.mutex);
  device.pinned.erase(static_cast<const char*>(memory));
  std::free(memory);
}

Stream::Stream() = default;
Stream::~Stream() {}  // a GPU has something to give back here
void Stream::Synchronize() const { RefuseInCapture("the stream is waited for"); }

void CopyToDevice(void* to, const void* from, size_t bytes, CudaStream /*stream*/) {
  RequireDevice(to, bytes);
  RequireHost(from, bytes);
  Queue([=] { std::memcpy(to, from, bytes); });
}
void CopyToHost(void* to, const void* from, size_t bytes, CudaStream /*stream*/) {
  RequireHost(to, bytes);
  RequireDevice(from, bytes);
  Queue([=] { std::memcpy(to, from, bytes); });
}
void Copy(void* to, const void* from, size_t bytes, CudaStream /*stream*/) {
  RequireDevice(to, bytes);
  RequireDevice(from, bytes);
  Queue([=] { std::memcpy(to, from, bytes); });
}
void Zero(void* memory, size_t bytes, CudaStream /*stream*/) {
  RequireDevice(memory, bytes);
  Queue([=] { std::memset(memory, 0, bytes); });
}

Mark::Mark() = default;
Mark::~Mark() {}
void Mark::Record(CudaStream /*stream*/) {}
void Mark::Wait() const { RefuseInCapture("a mark is waited for"); }

namespace {

struct Profile {
  std::map<std::string, ProfiledWork> works;
  std::string what;
  std::chrono::steady_clock::time_point begin;
};
std::unique_ptr<Profile>& TheProfile() {
  static std::unique_ptr<Profile> profile;
  return profile;
}

}  // namespace

void StartProfile() { TheProfile() = std::make_unique<Profile>(); }
std::map<std::string, ProfiledWork> EndProfile() { return std::exchange(TheProfile(), nullptr)->works; }

ProfileScope::ProfileScope(const char* what, CudaStream stream)
    : stream_(stream), recording_(TheProfile() != nullptr && TheDevice().capture == nullptr) {
  if (!recording_) return;
  TheProfile()->what = what;
  TheProfile()->begin = std::chrono::steady_clock::now();
}
ProfileScope::~ProfileScope() {
  if (!recording_) return;
  ProfiledWork& work = TheProfile()->works[TheProfile()->what];
  ++work.n;
  work.milliseconds +=
      std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - TheProfile()->begin).count();
}

size_t ScratchOfSums(int64_t n) { return static_cast<size_t>(n) * sizeof(int64_t); }

void ExclusiveSums(const int64_t* values, int64_t n, int64_t* sums, void* scratch, size_t scratch_bytes,
                   CudaStream /*stream*/) {
  RequireDevice(scratch, scratch_bytes);
  if (scratch_bytes < ScratchOfSums(n)) throw DeviceError("too little scratch memory for sums");
  Queue([=] {
    int64_t sum = 0;
    for (int64_t i = 0; i < n; ++i) {
      sums[i] = sum;
      sum += values[i];
    }
    sums[n] = sum;
  });
}

struct Matmul::State {};
size_t Matmul::WorkspaceBytes() { return 0; }
Matmul::Matmul(CudaStream /*stream*/) {}
Matmul::~Matmul() = default;

namespace {

template <typename T>
void Multiply(const MatmulArgs<T>& args) {
  const ProfileScope scope("products", nullptr);
  if (args.m % 8 != 0 || args.n % 8 != 0 || args.k % 8 != 0) throw DeviceError("sizes of products are multiples of 8");
  Queue([args] {
#pragma omp parallel for schedule(static)
    for (int64_t i = 0; i < args.m; ++i) {
      std::vector<float> row(static_cast<size_t>(args.n));
      for (int64_t k = 0; k < args.k; ++k) {
        const float a = ToFloat(args.a[args.a_transposed ? k * args.a_row + i : i * args.a_row + k]);
        for (int64_t j = 0; j < args.n; ++j) {
          row[j] += a * ToFloat(args.b[args.b_transposed ? j * args.b_row + k : k * args.b_row + j]);
        }
      }
      for (int64_t j = 0; j < args.n; ++j) {
        if (args.c != nullptr) FromFloat(row[j], args.c[i * args.c_row + j]);
        if (args.c_float != nullptr) args.c_float[i * args.c_row + j] = row[j];
      }
    }
  });
}

}  // namespace

void Matmul::operator()(const MatmulArgs<float>& args) const { Multiply(args); }
void Matmul::operator()(const MatmulArgs<Bf16>& args) const { Multiply(args); }

struct Graph::State {
  std::vector<Work> work;
};
Graph::Graph() = default;
Graph::~Graph() = default;
Graph::Graph(Graph&&) noexcept = default;
Graph& Graph::operator=(Graph&&) noexcept = default;

void Graph::Capture(CudaStream /*stream*/, const std::function<void()>& queue) {
  RefuseInCapture("another graph is captured");
  auto state = std::make_unique<State>();
  Device& device = TheDevice();
  device.capture = &state->work;
  struct End {
    ~End() { TheDevice().capture = nullptr; }
  } end;
  queue();
  state_ = std::move(state);
}

void Graph::Launch(CudaStream /*stream*/) const {
  RefuseInCapture("a graph is launched");
  for (const Work& work : state_->work) work();
}

void Submit(int64_t n, std::function<void(int64_t)> body) {
  Queue([n, body = std::move(body)] {
#pragma omp parallel for schedule(static) if (n > 64)
    for (int64_t i = 0; i < n; ++i) body(i);
  });
}

}  // namespace nrff::device
