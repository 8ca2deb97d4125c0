# groma_nanopb(<target> <dir>/<name>.proto): generates C from the schema with nanopb's own generator.
find_package(nanopb REQUIRED)
find_program(PROTOC protoc REQUIRED)
find_program(PROTOC_GEN_NANOPB protoc-gen-nanopb REQUIRED)

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
