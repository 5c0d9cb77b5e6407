// What headers of kernels need to be shared by the C++ and the CUDA compiler, without CUDA's own headers.
#pragma once

#if defined(__CUDACC__)
#define NRFF_HOST_DEVICE __host__ __device__
#else
#define NRFF_HOST_DEVICE
#endif

struct CUstream_st;

namespace nrff {

using CudaStream = CUstream_st*;  // cudaStream_t

}  // namespace nrff
