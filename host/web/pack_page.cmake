# Writes the files of the folder ${folder}, compressed, into ${source} as the function page_files(). Without a folder
# there are none.
set(entries "")
set(texts "")
set(number 0)
if(folder)
  file(GLOB_RECURSE files RELATIVE ${folder} ${folder}/*)
  foreach(name IN LISTS files)
    set(packed ${source}.gz)
    execute_process(COMMAND gzip -9 -n -c ${folder}/${name} OUTPUT_FILE ${packed} COMMAND_ERROR_IS_FATAL ANY)
    file(READ ${packed} bytes HEX)
    file(REMOVE ${packed})
    string(REGEX REPLACE "(................................................................)" "\\1\n" bytes "${bytes}")
    string(REGEX REPLACE "([0-9a-f][0-9a-f])" "\\\\x\\1" bytes "${bytes}")
    string(REPLACE "\n" "\"\n    \"" bytes "${bytes}")
    string(APPEND texts "constexpr char kFile${number}[] =\n    \"${bytes}\";\n")
    set(path "/${name}")
    if(name STREQUAL "index.html")
      set(path "/")
    endif()
    if(name MATCHES "\\.html$")
      set(type "text/html; charset=utf-8")
    elseif(name MATCHES "\\.js$")
      set(type "text/javascript; charset=utf-8")
    elseif(name MATCHES "\\.css$")
      set(type "text/css; charset=utf-8")
    elseif(name MATCHES "\\.svg$")
      set(type "image/svg+xml")
    else()
      message(FATAL_ERROR "pack_page.cmake knows no content type for ${name}")
    endif()
    string(APPEND entries "    {\"${path}\", \"${type}\", {kFile${number}, sizeof kFile${number} - 1}},\n")
    math(EXPR number "${number} + 1")
  endforeach()
endif()
if(number EQUAL 0)
  set(body "  return {};\n")
else()
  set(body "  static constexpr PageFile kFiles[] = {\n${entries}  };\n  return kFiles;\n")
endif()
file(
  WRITE ${source}
  "#include \"host/web/page_files.hpp\"

namespace groma::web {
namespace {

${texts}
}  // namespace

std::span<const PageFile> page_files() {
${body}}

}  // namespace groma::web
"
)
