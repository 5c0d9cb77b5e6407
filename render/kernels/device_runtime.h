// What programs for a GPU need of it: memory, a queue of work, kernels, sums, matrix products, and graphs of work that
// are queued as one.
//
// A kernel is a functor that is called with the indices 0 … n − 1, in any order and many at once; calls share memory by
// the atomic functions below alone. Programs written so compile twice: by nvcc for the GPU (device_runtime.cu), and by
// any C++ compiler into an emulation (tests/emulation) that tests run where there is no GPU. The emulation
// runs a kernel's calls on all cores, fills fresh memory with NaN, and refuses in a graph's capture what CUDA refuses.
//
// All functions throw DeviceError when the device or its driver reports an error, Allocate OutOfDeviceMemory.
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>

#include "render/kernels/device.h"
#include "render/kernels/device_number.h"

namespace nrff::device {

class DeviceError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

class OutOfDeviceMemory : public DeviceError {
 public:
  OutOfDeviceMemory(size_t asked, size_t free);
  size_t asked, free;  // bytes
};

struct DeviceFacts {
  std::string name;
  int compute_capability = 0;  // 10 · major + minor; 0: emulated
  size_t memory_bytes = 0, free_bytes = 0;
};
DeviceFacts GetDeviceFacts();

// Memory of the device, 256-byte aligned. Not while a graph is captured.
void* Allocate(size_t bytes);
void Free(void* memory) noexcept;
// Host memory that copies go from and to without waiting.
void* AllocatePinned(size_t bytes);
void FreePinned(void* memory) noexcept;

template <typename T>
class Buffer {
 public:
  Buffer() = default;
  explicit Buffer(int64_t n) : data_(static_cast<T*>(Allocate(static_cast<size_t>(n) * sizeof(T)))), n_(n) {}
  T* data() const { return data_.get(); }
  int64_t size() const { return n_; }

 private:
  struct Release {
    void operator()(T* memory) const { Free(memory); }
  };
  std::unique_ptr<T, Release> data_;
  int64_t n_ = 0;
};

template <typename T>
class PinnedBuffer {
 public:
  explicit PinnedBuffer(int64_t n) : data_(static_cast<T*>(AllocatePinned(static_cast<size_t>(n) * sizeof(T)))) {}
  T* data() const { return data_.get(); }
  T& operator[](int64_t i) const { return data_.get()[i]; }

 private:
  struct Release {
    void operator()(T* memory) const { FreePinned(memory); }
  };
  std::unique_ptr<T, Release> data_;
};

// A queue of work, done in order.
class Stream {
 public:
  Stream();
  ~Stream();
  Stream(const Stream&) = delete;
  Stream& operator=(const Stream&) = delete;
  CudaStream get() const { return stream_; }
  // Waits until all of it is done. Not while a graph is captured.
  void Synchronize() const;

 private:
  CudaStream stream_ = nullptr;
};

// Queued. Host memory that is not pinned is copied before the call returns; results arrive with Synchronize or Mark.
void CopyToDevice(void* to, const void* from, size_t bytes, CudaStream stream);
void CopyToHost(void* to, const void* from, size_t bytes, CudaStream stream);
void Copy(void* to, const void* from, size_t bytes, CudaStream stream);  // on the device
void Zero(void* memory, size_t bytes, CudaStream stream);

// A point in a stream that the host can wait for.
class Mark {
 public:
  Mark();
  ~Mark();
  Mark(const Mark&) = delete;
  Mark& operator=(const Mark&) = delete;
  void Record(CudaStream stream);
  void Wait() const;  // returns at once if never recorded

 private:
  void* event_ = nullptr;
};

// How long each kind of work takes between StartProfile and EndProfile, by its name. Work that is queued by a graph is
// not seen. One stream's at a time.
struct ProfiledWork {
  int64_t n = 0;  // times
  double milliseconds = 0;
};
void StartProfile();
std::map<std::string, ProfiledWork> EndProfile();
// Of one piece of work: while it lives, what is queued.
class ProfileScope {
 public:
  ProfileScope(const char* what, CudaStream stream);
  ~ProfileScope();
  ProfileScope(const ProfileScope&) = delete;
  ProfileScope& operator=(const ProfileScope&) = delete;

 private:
  CudaStream stream_ = nullptr;
  bool recording_ = false;
};

// sums[i] = Σ_{j < i} values[j] for i ≤ n. scratch: ScratchOfSums(n) bytes of the device.
size_t ScratchOfSums(int64_t n);
void ExclusiveSums(const int64_t* values, int64_t n, int64_t* sums, void* scratch, size_t scratch_bytes,
                   CudaStream stream);

// C[m][n] = Σ_k A(i, k) B(k, j), all row by row; products are summed in float.
template <typename T>
struct MatmulArgs {
  int64_t m = 0, n = 0, k = 0;
  const T* a = nullptr;  // [m][a_row], or [k][a_row] where a_transposed
  int64_t a_row = 0;
  bool a_transposed = false;
  const T* b = nullptr;  // [k][b_row], or [n][b_row] where b_transposed
  int64_t b_row = 0;
  bool b_transposed = false;
  // One of the two.
  T* c = nullptr;  // [m][c_row]
  float* c_float = nullptr;
  int64_t c_row = 0;
};

// Matrix products of a stream. T is float or Bf16. What a shape needs is found out once, so the first product of a
// shape must not be in a graph's capture.
class Matmul {
 public:
  explicit Matmul(CudaStream stream);
  ~Matmul();
  Matmul(const Matmul&) = delete;
  Matmul& operator=(const Matmul&) = delete;
  static size_t WorkspaceBytes();  // of the device's memory
  void operator()(const MatmulArgs<float>& args) const;
  void operator()(const MatmulArgs<Bf16>& args) const;

 private:
  struct State;
  std::unique_ptr<State> state_;
};

// Work that is recorded once and queued many times as one, with the same pointers and sizes.
class Graph {
 public:
  Graph();
  ~Graph();
  Graph(Graph&&) noexcept;
  Graph& operator=(Graph&&) noexcept;
  // `queue` queues the work on the stream; it is not done then. Throws DeviceError when it does what a graph cannot
  // hold: waits for the stream, allocates or frees memory of the device, or copies from or to host memory that is not
  // pinned.
  void Capture(CudaStream stream, const std::function<void()>& queue);
  void Launch(CudaStream stream) const;
  bool captured() const { return state_ != nullptr; }

 private:
  struct State;
  std::unique_ptr<State> state_;
};

#if defined(__CUDACC__)

void CheckLaunch(const char* what);

template <typename Body>
__global__ void RunKernel(int64_t n, const __grid_constant__ Body body) {
  const int64_t stride = int64_t(gridDim.x) * blockDim.x;
  for (int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x; i < n; i += stride) body(i);
}

// Queues body(i) for i < n. `what` names the kernel in errors.
template <typename Body>
void ForEach(const char* what, int64_t n, CudaStream stream, const Body& body) {
  if (n <= 0) return;
  const ProfileScope scope(what, stream);
  constexpr int kThreads = 128;
  constexpr int64_t kMostBlocks = int64_t{1} << 30;
  const int64_t n_blocks = (n + kThreads - 1) / kThreads;
  RunKernel<<<static_cast<unsigned>(n_blocks < kMostBlocks ? n_blocks : kMostBlocks), kThreads, 0, stream>>>(n, body);
  CheckLaunch(what);
}

#else

// Does the work on all cores, or records it.
void Submit(int64_t n, std::function<void(int64_t)> body);

template <typename Body>
void ForEach(const char* what, int64_t n, CudaStream stream, const Body& body) {
  const ProfileScope scope(what, stream);
  if (n > 0) Submit(n, body);
}

#endif

NRFF_HOST_DEVICE inline void AtomicAdd(float* to, float x) {
#if defined(__CUDA_ARCH__)
  atomicAdd(to, x);
#else
  std::atomic_ref(*to).fetch_add(x, std::memory_order_relaxed);
#endif
}

NRFF_HOST_DEVICE inline void AtomicAdd(double* to, double x) {
#if defined(__CUDA_ARCH__)
  atomicAdd(to, x);
#else
  std::atomic_ref(*to).fetch_add(x, std::memory_order_relaxed);
#endif
}

// Of two or four neighbours; `to` is aligned to all of them.
NRFF_HOST_DEVICE inline void AtomicAdd2(float* to, float x, float y) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
  atomicAdd(reinterpret_cast<float2*>(to), make_float2(x, y));
#else
  AtomicAdd(to, x);
  AtomicAdd(to + 1, y);
#endif
}
NRFF_HOST_DEVICE inline void AtomicAdd4(float* to, const float* x) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
  atomicAdd(reinterpret_cast<float4*>(to), make_float4(x[0], x[1], x[2], x[3]));
#else
  for (int c = 0; c < 4; ++c) AtomicAdd(to + c, x[c]);
#endif
}

NRFF_HOST_DEVICE inline void AtomicMin(unsigned long long* to, unsigned long long x) {
#if defined(__CUDA_ARCH__)
  atomicMin(to, x);
#else
  std::atomic_ref at(*to);
  unsigned long long seen = at.load(std::memory_order_relaxed);
  while (x < seen && !at.compare_exchange_weak(seen, x, std::memory_order_relaxed)) {
  }
#endif
}

}  // namespace nrff::device
