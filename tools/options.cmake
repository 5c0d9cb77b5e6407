# Warnings, sanitizers, and the three ways a target is made here.

add_library(nrff_options INTERFACE)
target_include_directories(nrff_options INTERFACE ${PROJECT_SOURCE_DIR})
target_compile_options(nrff_options INTERFACE -Wall -Wextra)
if(NRFF_SANITIZE)
  target_compile_options(nrff_options INTERFACE -fsanitize=address,undefined -fno-sanitize-recover=undefined -fno-omit-frame-pointer)
  target_link_options(nrff_options INTERFACE -fsanitize=address,undefined)
endif()
if(NRFF_FUZZ)
  set(sanitizers -fsanitize=address,undefined,float-cast-overflow -fno-sanitize-recover=all)
  target_compile_options(nrff_options INTERFACE ${sanitizers} -fsanitize=fuzzer-no-link -O1 -fno-omit-frame-pointer)
  target_compile_definitions(nrff_options INTERFACE _GLIBCXX_ASSERTIONS)
  target_link_options(nrff_options INTERFACE ${sanitizers})
endif()

# Only there, so that another version compiles one file anew.
set_source_files_properties(pipeline/manifest.cc PROPERTIES COMPILE_DEFINITIONS NRFF_VERSION="${PROJECT_VERSION}")

# nrff_artifact and nrff_driver share the folder pipeline/; a stage links the first only.
set(ARTIFACT_SOURCES
  pipeline/extension.cc pipeline/files.cc pipeline/json.cc pipeline/log.cc pipeline/manifest.cc pipeline/needs.cc
  pipeline/photo_name.cc pipeline/process.cc pipeline/progress.cc pipeline/scene.cc pipeline/stage.cc)
file(GLOB DRIVER_SOURCES CONFIGURE_DEPENDS pipeline/*.cc)
list(REMOVE_ITEM DRIVER_SOURCES pipeline/nrff_main.cc)
foreach(source IN LISTS ARTIFACT_SOURCES)
  list(REMOVE_ITEM DRIVER_SOURCES ${PROJECT_SOURCE_DIR}/${source})
endforeach()
list(FILTER DRIVER_SOURCES EXCLUDE REGEX "nrff_main\\.cc$")

# Sources are compiled with -Wall -Wextra; headers of what is linked count as system headers (CMake's default for
# imported targets).
function(nrff_library name)
  cmake_parse_arguments(ARG "" "" "SOURCES;FOLDER;LINK" ${ARGN})
  foreach(folder IN LISTS ARG_FOLDER)
    file(GLOB found CONFIGURE_DEPENDS ${folder}/*.cc)
    list(FILTER found EXCLUDE REGEX "_main\\.cc$")
    list(APPEND ARG_SOURCES ${found})
  endforeach()
  add_library(${name} STATIC ${ARG_SOURCES})
  target_link_libraries(${name} PRIVATE nrff_options PUBLIC ${ARG_LINK})
endfunction()

function(nrff_executable name source)
  cmake_parse_arguments(ARG "" "" "LINK" ${ARGN})
  add_executable(${name} ${source})
  target_link_libraries(${name} PRIVATE nrff_options ${ARG_LINK})
  install(TARGETS ${name} RUNTIME DESTINATION ${CMAKE_INSTALL_BINDIR})
endfunction()

function(nrff_test name)
  cmake_parse_arguments(ARG "" "TIMEOUT;LABEL;PREFIX" "SOURCES;LINK" ${ARGN})
  add_executable(${name} ${ARG_SOURCES})
  target_link_libraries(${name} PRIVATE nrff_options ${ARG_LINK} GTest::gmock GTest::gtest_main)
  target_compile_definitions(${name} PRIVATE NRFF_SOURCE_DIR="${PROJECT_SOURCE_DIR}" NRFF_BIN_DIR="${CMAKE_RUNTIME_OUTPUT_DIRECTORY}")
  set_target_properties(${name} PROPERTIES RUNTIME_OUTPUT_DIRECTORY ${CMAKE_BINARY_DIR}/tests)
  if(NOT ARG_TIMEOUT)
    set(ARG_TIMEOUT 300)
  endif()
  set(properties TIMEOUT ${ARG_TIMEOUT})
  if(ARG_LABEL)
    list(APPEND properties LABELS ${ARG_LABEL})
  endif()
  if(NRFF_SANITIZE)
    set(options "suppressions=${PROJECT_SOURCE_DIR}/tests/lsan.supp")
    # OpenImageIO's leak is known by a frame beyond libraries without frame pointers; training would be thrice as slow.
    if(ARG_LINK MATCHES "nrff_sfm|nrff_eval")
      string(APPEND options ":fast_unwind_on_malloc=0:malloc_context_size=20")
    endif()
    list(APPEND properties ENVIRONMENT "LSAN_OPTIONS=${options}")
  endif()
  gtest_discover_tests(${name} DISCOVERY_MODE PRE_TEST TEST_PREFIX "${ARG_PREFIX}" PROPERTIES ${properties})
endfunction()
