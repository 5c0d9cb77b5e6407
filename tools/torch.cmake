# torch::cpu: libtorch_cpu and libc10 of the wheel, and the two small CUDA libraries that libtorch_cpu itself needs.
if(NOT NRFF_TORCH_DIR)
  if(DEFINED ENV{NRFF_DEPS})
    set(NRFF_TORCH_DIR $ENV{NRFF_DEPS}/torch-2.11.0)
  else()
    set(NRFF_TORCH_DIR $ENV{HOME}/.cache/nrff/torch-2.11.0)
  endif()
endif()
if(NOT EXISTS ${NRFF_TORCH_DIR}/torch/lib/libtorch_cpu.so)
  message(FATAL_ERROR "libtorch is not at ${NRFF_TORCH_DIR}: run tools/setup.sh, or give -DNRFF_TORCH_DIR=DIR "
                      "where DIR/torch/lib/libtorch_cpu.so is")
endif()
# In this order: the wheel's libgomp is the one OpenMP runtime of every program that links torch.
set(TORCH_LIB ${NRFF_TORCH_DIR}/torch/lib)
set(TORCH_RPATH ${TORCH_LIB} ${NRFF_TORCH_DIR}/nvidia/cu13/lib)
add_library(torch::cpu INTERFACE IMPORTED)
target_include_directories(torch::cpu SYSTEM INTERFACE
  ${NRFF_TORCH_DIR}/torch/include ${NRFF_TORCH_DIR}/torch/include/torch/csrc/api/include)
target_link_libraries(torch::cpu INTERFACE ${TORCH_LIB}/libtorch_cpu.so ${TORCH_LIB}/libc10.so)
string(JOIN ":" torch_rpath_link ${TORCH_RPATH})
# DT_RPATH, not RUNPATH: it also holds for what libtorch_cpu itself loads.
target_link_options(torch::cpu INTERFACE
  -Wl,--disable-new-dtags -Wl,-rpath,${torch_rpath_link} -Wl,-rpath-link,${torch_rpath_link})
