# nrff_embed(TARGET FUNCTION FOLDER): puts the files of FOLDER into TARGET as text, by file name:
#   std::string_view nrff::FUNCTION(std::string_view name), which throws std::out_of_range for an unknown name.
function(nrff_embed target function folder)
  file(GLOB files CONFIGURE_DEPENDS ${folder}/*)
  set(entries "")
  foreach(file IN LISTS files)
    set_property(DIRECTORY APPEND PROPERTY CMAKE_CONFIGURE_DEPENDS ${file})
    file(READ ${file} text)
    get_filename_component(name ${file} NAME)
    string(APPEND entries "      {\"${name}\", R\"nrff_text(${text})nrff_text\"},\n")
  endforeach()
  set(source ${CMAKE_CURRENT_BINARY_DIR}/${function}.cc)
  file(CONFIGURE OUTPUT ${source} @ONLY CONTENT
"#include <map>
#include <string_view>

namespace nrff {

std::string_view @function@(std::string_view name) {
  static const std::map<std::string_view, std::string_view> files = {
@entries@  };
  return files.at(name);
}

}  // namespace nrff
")
  target_sources(${target} PRIVATE ${source})
endfunction()
