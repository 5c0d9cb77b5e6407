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
