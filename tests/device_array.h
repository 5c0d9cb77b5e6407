// Arrays on the GPU, for tests of CUDA twins.
#pragma once

#include <cuda_runtime.h>

#include <algorithm>
#include <stdexcept>
#include <vector>

namespace nrff {

inline void CheckCuda(cudaError_t error) {
  if (error != cudaSuccess) throw std::runtime_error(cudaGetErrorString(error));
}

inline bool HasGpu() {
  int n_gpus = 0;
  return cudaGetDeviceCount(&n_gpus) == cudaSuccess && n_gpus > 0;
}

template <typename T>
class DeviceArray {
 public:
  DeviceArray(const T* host, size_t n) : n_(n) {
    CheckCuda(cudaMalloc(reinterpret_cast<void**>(&data_), std::max<size_t>(1, n) * sizeof(T)));
    CheckCuda(cudaMemcpy(data_, host, n * sizeof(T), cudaMemcpyHostToDevice));
  }
  explicit DeviceArray(const std::vector<T>& host) : DeviceArray(host.data(), host.size()) {}
  ~DeviceArray() { cudaFree(data_); }
  DeviceArray(const DeviceArray&) = delete;
  DeviceArray& operator=(const DeviceArray&) = delete;

  T* get() const { return data_; }
  void CopyTo(T* host) const { CheckCuda(cudaMemcpy(host, data_, n_ * sizeof(T), cudaMemcpyDeviceToHost)); }
  std::vector<T> Host() const {
    std::vector<T> host(n_);
    CopyTo(host.data());
    return host;
  }

 private:
  size_t n_;
  T* data_ = nullptr;
};

}  // namespace nrff
