find_path(XXHASH_INCLUDE_DIR xxhash.h REQUIRED)
add_library(xxhash INTERFACE IMPORTED)  # header-only (XXH_INLINE_ALL)
target_include_directories(xxhash SYSTEM INTERFACE ${XXHASH_INCLUDE_DIR})

# Static, so that nrff-train and nrff-render need no image library where they run.
find_path(PNG_INCLUDE_DIR png.h REQUIRED)
find_library(PNG_STATIC_LIBRARY libpng.a REQUIRED)
find_library(ZLIB_STATIC_LIBRARY libz.a REQUIRED)
add_library(png_static INTERFACE IMPORTED)
target_include_directories(png_static SYSTEM INTERFACE ${PNG_INCLUDE_DIR})
target_link_libraries(png_static INTERFACE ${PNG_STATIC_LIBRARY} ${ZLIB_STATIC_LIBRARY} m)

# OpenCV's modules one by one: Debian's OpenCVConfig.cmake comes only with the package of all modules, which brings
# VTK, Java and several hundred megabytes along.
find_path(OPENCV_INCLUDE_DIR opencv2/core.hpp PATH_SUFFIXES opencv4 REQUIRED)
foreach(module core imgproc calib3d dnn)
  find_library(OPENCV_${module}_LIBRARY opencv_${module} REQUIRED)
  add_library(opencv_${module} INTERFACE IMPORTED)
  target_include_directories(opencv_${module} SYSTEM INTERFACE ${OPENCV_INCLUDE_DIR})
  target_link_libraries(opencv_${module} INTERFACE ${OPENCV_${module}_LIBRARY})
endforeach()

# Debian's OpenImageIO and Imath packages for CMake name tools and Python bindings of other packages and fail without them.
find_path(OPENIMAGEIO_INCLUDE_DIR OpenImageIO/imageio.h REQUIRED)
find_path(IMATH_INCLUDE_DIR ImathVec.h PATH_SUFFIXES Imath REQUIRED)
find_library(OPENIMAGEIO_LIBRARY OpenImageIO REQUIRED)
find_library(OPENIMAGEIO_UTIL_LIBRARY OpenImageIO_Util REQUIRED)
add_library(openimageio INTERFACE IMPORTED)
target_include_directories(openimageio SYSTEM INTERFACE ${OPENIMAGEIO_INCLUDE_DIR} ${IMATH_INCLUDE_DIR})
target_link_libraries(openimageio INTERFACE ${OPENIMAGEIO_LIBRARY} ${OPENIMAGEIO_UTIL_LIBRARY})

# By flag, not by library path: programs that also link torch take the one libgomp.so.1 of its wheel.
add_library(openmp INTERFACE IMPORTED)
target_compile_options(openmp INTERFACE -fopenmp)
target_link_options(openmp INTERFACE -fopenmp)
