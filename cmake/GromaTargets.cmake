# One way to declare each kind of target, so that warnings, include paths and
# sanitizers are the same everywhere.

if(NOT CMAKE_CROSSCOMPILING)
  find_package(Threads REQUIRED)
  find_package(Eigen3 3.4 REQUIRED NO_MODULE)
  find_package(fmt REQUIRED)
endif()

add_library(groma_build_options INTERFACE)
target_compile_options(
  groma_build_options
  INTERFACE
    -Wall
    -Wextra
    -Wpedantic
    -Werror
    -Wshadow
    -Wconversion
    -Wsign-conversion
    -Wdouble-promotion
    -Wnull-dereference
    $<$<COMPILE_LANGUAGE:CXX>:-Wold-style-cast>
    $<$<COMPILE_LANGUAGE:CXX>:-Wnon-virtual-dtor>
    -ffp-contract=off
)
# -Wnull-dereference and -Wmaybe-uninitialized see ghosts through sanitizer instrumentation in GCC 12.
if(GROMA_SANITIZE)
  target_compile_options(
    groma_build_options
    INTERFACE
      -fsanitize=${GROMA_SANITIZE}
      -fno-sanitize-recover=all
      -fno-omit-frame-pointer
      -Wno-null-dereference
      -Wno-maybe-uninitialized
  )
  target_link_options(groma_build_options INTERFACE -fsanitize=${GROMA_SANITIZE})
endif()
target_include_directories(groma_build_options INTERFACE ${CMAKE_SOURCE_DIR})

# To depend on where GCC 12 takes Eigen's dynamic matrices for null after a failed allocation.
add_library(groma_dynamic_eigen INTERFACE)
target_compile_options(groma_dynamic_eigen INTERFACE -Wno-null-dereference)

# groma_library(NAME <name> SOURCES ... [DEPENDS ...] [APART]); a library without sources is an interface. APART: each
# source is compiled alone also where CMAKE_UNITY_BUILD is set.
function(groma_library)
  cmake_parse_arguments(arg "APART" "NAME" "SOURCES;DEPENDS" ${ARGN})
  if(arg_SOURCES)
    add_library(${arg_NAME} STATIC ${arg_SOURCES})
    target_link_libraries(${arg_NAME} PRIVATE groma_build_options PUBLIC ${arg_DEPENDS})
    target_include_directories(${arg_NAME} PUBLIC ${CMAKE_SOURCE_DIR})
    if(arg_APART)
      set_target_properties(${arg_NAME} PROPERTIES UNITY_BUILD OFF)
    endif()
  else()
    add_library(${arg_NAME} INTERFACE)
    target_link_libraries(${arg_NAME} INTERFACE ${arg_DEPENDS})
    target_include_directories(${arg_NAME} INTERFACE ${CMAKE_SOURCE_DIR})
  endif()
endfunction()

# groma_executable(NAME <name> SOURCES ... [DEPENDS ...])
function(groma_executable)
  cmake_parse_arguments(arg "" "NAME" "SOURCES;DEPENDS" ${ARGN})
  add_executable(${arg_NAME} ${arg_SOURCES})
  target_link_libraries(${arg_NAME} PRIVATE groma_build_options ${arg_DEPENDS})
endfunction()

# groma_test(NAME <name> SOURCES ... [DEPENDS ...] [DEFINITIONS ...] [LABELS ...] [TIMEOUT s] [STATISTICS]): a GoogleTest
# program, each case a CTest test, with the labels of GROMA_TEST_LABELS, too. One labelled long is there with
# GROMA_LONG_TESTS only, one of STATISTICS not under a sanitizer: many drives go no other way than single ones.
function(groma_test)
  cmake_parse_arguments(arg "STATISTICS" "NAME;TIMEOUT" "SOURCES;DEPENDS;DEFINITIONS;LABELS" ${ARGN})
  if(("long" IN_LIST arg_LABELS AND NOT GROMA_LONG_TESTS) OR (arg_STATISTICS AND GROMA_SANITIZE))
    return()
  endif()
  if(NOT arg_TIMEOUT)
    set(arg_TIMEOUT 120)
  endif()
  if(GROMA_SANITIZE)
    math(EXPR arg_TIMEOUT "3 * ${arg_TIMEOUT}")
  endif()
  list(APPEND arg_LABELS ${GROMA_TEST_LABELS})
  add_executable(${arg_NAME} ${arg_SOURCES})
  # What takes operator new's place is not to be seen where it is called.
  set(support ${arg_SOURCES})
  list(FILTER support INCLUDE REGEX "/test/support/")
  set_source_files_properties(${support} PROPERTIES SKIP_UNITY_BUILD_INCLUSION ON)
  target_link_libraries(${arg_NAME} PRIVATE groma_build_options ${arg_DEPENDS} GTest::gtest GTest::gmock GTest::gtest_main)
  target_compile_definitions(${arg_NAME} PRIVATE ${arg_DEFINITIONS})
  gtest_discover_tests(
    ${arg_NAME}
    TEST_PREFIX ${arg_NAME}.
    DISCOVERY_MODE PRE_TEST
    PROPERTIES TIMEOUT ${arg_TIMEOUT} LABELS "${arg_LABELS}"
  )
endfunction()

# groma_campaign(NAME <name> SOURCES ... SHORT ... LONG ... [DEPENDS ...] [TIMEOUT s] [STATISTICS]): the tests <name>_test and,
# long, <name> of the same sources; SHORT and LONG are their definitions, TIMEOUT is the long one's.
function(groma_campaign)
  cmake_parse_arguments(arg "STATISTICS" "NAME;TIMEOUT" "SOURCES;DEPENDS;SHORT;LONG" ${ARGN})
  set(common SOURCES ${arg_SOURCES} DEPENDS ${arg_DEPENDS})
  if(arg_STATISTICS)
    list(APPEND common STATISTICS)
  endif()
  groma_test(NAME ${arg_NAME}_test ${common} DEFINITIONS ${arg_SHORT})
  groma_test(NAME ${arg_NAME} ${common} DEFINITIONS ${arg_LONG} LABELS long TIMEOUT ${arg_TIMEOUT})
endfunction()

# groma_benchmark(NAME <name> SOURCES ... [DEPENDS ...]); there is none under a sanitizer.
function(groma_benchmark)
  if(GROMA_SANITIZE)
    return()
  endif()
  cmake_parse_arguments(arg "" "NAME" "SOURCES;DEPENDS" ${ARGN})
  add_executable(${arg_NAME} ${arg_SOURCES})
  target_link_libraries(${arg_NAME} PRIVATE groma_build_options ${arg_DEPENDS} benchmark::benchmark benchmark::benchmark_main)
endfunction()
