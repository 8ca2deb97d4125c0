# groma_nanopb(<target> <dir>/<name>.proto): generates C from the schema with nanopb's own generator.
find_program(PROTOC protoc REQUIRED)
find_program(PROTOC_GEN_NANOPB protoc-gen-nanopb REQUIRED)
if(GROMA_BARE_METAL)
  # Debian has nanopb's library only for the host; scripts/setup fetches the sources of the same version.
  file(STRINGS /usr/include/pb.h nanopb_version REGEX "define NANOPB_VERSION")
  string(REGEX REPLACE ".*nanopb-([0-9.]+).*" "\\1" nanopb_version "${nanopb_version}")
  set(nanopb_cache "$ENV{XDG_CACHE_HOME}")
  if(NOT nanopb_cache)
    set(nanopb_cache "$ENV{HOME}/.cache")
  endif()
  set(nanopb_dir ${nanopb_cache}/groma/nanopb-${nanopb_version})
  if(NOT EXISTS ${nanopb_dir}/pb_encode.c)
    message(FATAL_ERROR "No ${nanopb_dir}/pb_encode.c; run: scripts/setup firmware")
  endif()
  add_library(groma_nanopb_runtime STATIC ${nanopb_dir}/pb_common.c ${nanopb_dir}/pb_decode.c ${nanopb_dir}/pb_encode.c)
  target_include_directories(groma_nanopb_runtime SYSTEM PUBLIC ${nanopb_dir})
  add_library(nanopb::protobuf-nanopb-static ALIAS groma_nanopb_runtime)
else()
  find_package(nanopb REQUIRED)
endif()

function(groma_nanopb target schema)
  get_filename_component(dir ${schema} DIRECTORY)
  get_filename_component(name ${schema} NAME_WE)
  set(out ${CMAKE_CURRENT_BINARY_DIR}/generated)
  file(MAKE_DIRECTORY ${out})
  # Run in the schema's folder so that the generator finds the .options file beside it.
  add_custom_command(
    OUTPUT ${out}/${name}.pb.c ${out}/${name}.pb.h
    COMMAND ${PROTOC} --plugin=protoc-gen-nanopb=${PROTOC_GEN_NANOPB} --nanopb_out=${out} ${name}.proto
    DEPENDS ${dir}/${name}.proto ${dir}/${name}.options
    WORKING_DIRECTORY ${dir}
    COMMENT "nanopb: ${name}.proto"
    VERBATIM
  )
  add_library(${target} STATIC ${out}/${name}.pb.c)
  target_include_directories(${target} SYSTEM PUBLIC ${out})
  target_link_libraries(${target} PUBLIC nanopb::protobuf-nanopb-static)
endfunction()
