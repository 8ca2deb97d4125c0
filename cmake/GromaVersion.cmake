# groma_version: the header "generated/groma_version.hpp" with the project's version and the commit it is
# built from. It is written again when HEAD moves; outside a git repository the hash is 0.
find_package(Git QUIET)
set(version_header ${CMAKE_BINARY_DIR}/generated/groma_version.hpp)
set(version_dependencies ${CMAKE_SOURCE_DIR}/cmake/WriteVersion.cmake)
if(Git_FOUND)
  foreach(name HEAD logs/HEAD)
    execute_process(
      COMMAND ${GIT_EXECUTABLE} rev-parse --git-path ${name}
      WORKING_DIRECTORY ${CMAKE_SOURCE_DIR}
      OUTPUT_VARIABLE path
      OUTPUT_STRIP_TRAILING_WHITESPACE
      ERROR_QUIET
    )
    get_filename_component(path "${path}" ABSOLUTE BASE_DIR ${CMAKE_SOURCE_DIR})
    if(EXISTS ${path} AND NOT IS_DIRECTORY ${path})
      list(APPEND version_dependencies ${path})
    endif()
  endforeach()
endif()

add_custom_command(
  OUTPUT ${version_header}
  COMMAND
    ${CMAKE_COMMAND} -DVERSION=${PROJECT_VERSION} -DGIT=${GIT_EXECUTABLE} -DSOURCE_DIR=${CMAKE_SOURCE_DIR}
    -DHEADER=${version_header} -P ${CMAKE_SOURCE_DIR}/cmake/WriteVersion.cmake
  DEPENDS ${version_dependencies}
  COMMENT "Version and commit"
  VERBATIM
)
add_custom_target(groma_version_header DEPENDS ${version_header})
add_library(groma_version INTERFACE)
add_dependencies(groma_version groma_version_header)
target_include_directories(groma_version INTERFACE ${CMAKE_BINARY_DIR})
