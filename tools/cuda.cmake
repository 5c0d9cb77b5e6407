# nrff_cuda: the CUDA twins of the kernels as one shared library with the CUDA runtime inside, so that what uses it needs
# nothing but a driver where it runs. Built for Ampere and Hopper, and as PTX for what comes after.
include(CheckLanguage)
check_language(CUDA)
if(NOT CMAKE_CUDA_COMPILER)
  message(FATAL_ERROR "the preset cuda needs nvcc of the CUDA toolkit on the PATH or in CUDACXX; the others need none")
endif()
enable_language(CUDA)
find_package(CUDAToolkit REQUIRED)
file(GLOB cuda_sources CONFIGURE_DEPENDS render/kernels/*.cu model/kernels/*.cu)
add_library(nrff_cuda SHARED ${cuda_sources})
# CMake 3.25 knows no C++20 dialect of CUDA 13; kernels need none.
set_target_properties(nrff_cuda PROPERTIES CUDA_ARCHITECTURES "80-real;90-real;90-virtual" CUDA_STANDARD 17
                                           CUDA_RUNTIME_LIBRARY Static)
target_include_directories(nrff_cuda PRIVATE ${PROJECT_SOURCE_DIR})
target_compile_options(nrff_cuda PRIVATE "$<$<COMPILE_LANGUAGE:CUDA>:-Xcompiler=-Wall,-Wextra>")
