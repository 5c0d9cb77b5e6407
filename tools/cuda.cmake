# nrff_cuda: the CUDA half of the model as one shared library with the CUDA runtime inside, so that what opens it needs
# a driver and cuBLASLt where it runs. Built for Ampere and Hopper, and as PTX for what comes after.
if(NOT CMAKE_CUDA_COMPILER)
  message(FATAL_ERROR "NRFF_CUDA needs nvcc of the CUDA toolkit on the PATH or in CUDACXX")
endif()
enable_language(CUDA)
find_package(CUDAToolkit REQUIRED)
file(GLOB cuda_sources CONFIGURE_DEPENDS render/kernels/*.cu model/cuda/*.cu)
add_library(nrff_cuda SHARED ${cuda_sources} model/cuda/gpu_room.cc)
# CMake 3.25 does not know how CUDA 13 is told of C++20.
set(CMAKE_CUDA20_STANDARD_COMPILE_OPTION -std=c++20)
set(CMAKE_CUDA20_EXTENSION_COMPILE_OPTION -std=c++20)
function(nrff_cuda_options target)
  set_target_properties(${target} PROPERTIES CUDA_ARCHITECTURES "80-real;90-real;90-virtual" CUDA_RUNTIME_LIBRARY Static)
  target_include_directories(${target} PRIVATE ${PROJECT_SOURCE_DIR})
  target_compile_options(${target} PRIVATE
    "$<$<COMPILE_LANGUAGE:CUDA>:--expt-relaxed-constexpr;-Xcompiler=-Wall,-Wextra>")
endfunction()
nrff_cuda_options(nrff_cuda)
target_compile_definitions(nrff_cuda PRIVATE NRFF_VERSION="${PROJECT_VERSION}")
target_link_libraries(nrff_cuda PRIVATE CUDA::cublasLt)
set_target_properties(nrff_cuda PROPERTIES INSTALL_RPATH "$ORIGIN;${TORCH_RPATH}")
install(TARGETS nrff_cuda LIBRARY DESTINATION ${CMAKE_INSTALL_LIBDIR})
