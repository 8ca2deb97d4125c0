# Functions to declare each kind of target, so that warnings, include paths and sanitizers are the same
# everywhere.

if(NOT GROMA_BARE_METAL)
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
    -fno-math-errno
)
# Eigen sums large products in blocks as long as the processor's caches allow, so that the last bits of an estimate
# would depend on the machine. Without CPUID it assumes the same caches everywhere.
target_compile_definitions(groma_build_options INTERFACE EIGEN_NO_CPUID)
# Only the release build has warnings: instrumentation causes false ones.
if(GROMA_SANITIZE)
  target_compile_options(
    groma_build_options
    INTERFACE
      -fsanitize=${GROMA_SANITIZE}
      -fno-sanitize-recover=all
      -fno-omit-frame-pointer
      -w
  )
  if(GROMA_SANITIZE_NOT)
    target_compile_options(groma_build_options INTERFACE -fno-sanitize=${GROMA_SANITIZE_NOT})
  endif()
  # Not position-independent: a program starts in half of the time.
  target_compile_options(groma_build_options INTERFACE -fno-pie)
  target_link_options(groma_build_options INTERFACE -fsanitize=${GROMA_SANITIZE} -no-pie)
endif()
target_include_directories(groma_build_options INTERFACE ${CMAKE_SOURCE_DIR})
# About 60 programs: lld links them in a third of the time.
find_program(GROMA_LLD ld.lld)
if(GROMA_LLD AND NOT GROMA_BARE_METAL)
  target_link_options(groma_build_options INTERFACE -fuse-ld=lld)
endif()

# For host/ and for tests: pointers are cast to bytes and to sockaddr there, and by Eigen, which asserts their
# alignment itself. A check of each access takes a sixth to a quarter of their sanitized build.
add_library(groma_host_options INTERFACE)
if(GROMA_SANITIZE_NOT)
  target_compile_options(groma_host_options INTERFACE -fno-sanitize=alignment)
endif()
function(groma_use_build_options target)
  target_link_libraries(${target} PRIVATE $<BUILD_INTERFACE:groma_build_options>)
  if(CMAKE_CURRENT_SOURCE_DIR MATCHES "^${CMAKE_SOURCE_DIR}/host/")
    target_link_libraries(${target} PRIVATE $<BUILD_INTERFACE:groma_host_options>)
  endif()
endfunction()

# For tests, which take longer to build than to run. At -O1 GCC 12 wrongly assumes that Eigen's dynamic matrices
# are null.
add_library(groma_test_options INTERFACE)
target_compile_options(
  groma_test_options
  INTERFACE
    "$<$<CONFIG:Release>:-g0>"
    -Wno-null-dereference
)
if(GROMA_SANITIZE_NOT)
  target_compile_options(groma_test_options INTERFACE -g0)
endif()
target_link_libraries(groma_test_options INTERFACE groma_host_options)
add_library(groma_unoptimized INTERFACE)
target_compile_options(groma_unoptimized INTERFACE $<IF:$<BOOL:${GROMA_BARE_METAL}>,-O1,-O0>)
add_library(groma_little_optimized INTERFACE)
target_compile_options(groma_little_optimized INTERFACE "$<$<CONFIG:Release>:-O1>")

# For targets in which GCC 12 warns that Eigen's dynamic matrices are null after a failed allocation.
add_library(groma_dynamic_eigen INTERFACE)
target_compile_options(groma_dynamic_eigen INTERFACE -Wno-null-dereference)

# The linker takes the first instance of a template that it meets. With the optimized libraries that it depends
# on first, a program that is not optimized runs Eigen at their speed. Called when all targets are known.
function(groma_prefer_their_instances target)
  set(first "")
  set(seen ${target})
  get_target_property(queue ${target} LINK_LIBRARIES)
  while(queue)
    list(POP_FRONT queue library)
    if(NOT library MATCHES "^groma_" OR library IN_LIST seen)
      continue()
    endif()
    list(APPEND seen ${library})
    get_target_property(type ${library} TYPE)
    get_target_property(is_unoptimized ${library} GROMA_UNOPTIMIZED)
    get_target_property(more ${library} INTERFACE_LINK_LIBRARIES)
    if(type STREQUAL STATIC_LIBRARY AND NOT is_unoptimized)
      string(APPEND first " $<TARGET_FILE:${library}>")
    endif()
    if(more)
      list(APPEND queue ${more})
    endif()
  endwhile()
  if(first)
    target_link_options(${target} PRIVATE "SHELL:-Wl,--whole-archive${first} -Wl,--no-whole-archive")
  endif()
endfunction()
# EVAL: the name now, the call at the end.
function(groma_prefer_their_instances_at_end target)
  cmake_language(EVAL CODE "cmake_language(DEFER DIRECTORY \"${CMAKE_SOURCE_DIR}\" CALL groma_prefer_their_instances ${target})")
endfunction()
# Under a sanitizer.
function(groma_compile_unoptimized target)
  if(NOT GROMA_SANITIZE)
    return()
  endif()
  target_compile_options(${target} PRIVATE -O0)
  set_target_properties(${target} PROPERTIES GROMA_UNOPTIMIZED ON)
  get_target_property(type ${target} TYPE)
  if(type STREQUAL EXECUTABLE)
    groma_prefer_their_instances_at_end(${target})
  endif()
endfunction()

# groma_library(NAME <name> SOURCES ... [DEPENDS ...] [APART] [UNOPTIMIZED]); a library without sources is an interface.
# APART: each source is compiled separately, even with CMAKE_UNITY_BUILD. UNOPTIMIZED: it computes little, and
# under a sanitizer is compiled in half the time so.
function(groma_library)
  cmake_parse_arguments(arg "APART;UNOPTIMIZED" "NAME" "SOURCES;DEPENDS" ${ARGN})
  if(arg_SOURCES)
    add_library(${arg_NAME} STATIC ${arg_SOURCES})
    groma_use_build_options(${arg_NAME})
    target_link_libraries(${arg_NAME} PUBLIC ${arg_DEPENDS})
    if(arg_UNOPTIMIZED)
      groma_compile_unoptimized(${arg_NAME})
    endif()
    target_include_directories(${arg_NAME} PUBLIC $<BUILD_INTERFACE:${CMAKE_SOURCE_DIR}>)
    if(arg_APART)
      set_target_properties(${arg_NAME} PROPERTIES UNITY_BUILD OFF)
    endif()
  else()
    add_library(${arg_NAME} INTERFACE)
    target_link_libraries(${arg_NAME} INTERFACE ${arg_DEPENDS})
    target_include_directories(${arg_NAME} INTERFACE ${CMAKE_SOURCE_DIR})
  endif()
endfunction()

# groma_executable(NAME <name> SOURCES ... [DEPENDS ...] [UNOPTIMIZED])
function(groma_executable)
  cmake_parse_arguments(arg "UNOPTIMIZED" "NAME" "SOURCES;DEPENDS" ${ARGN})
  add_executable(${arg_NAME} ${arg_SOURCES})
  groma_use_build_options(${arg_NAME})
  target_link_libraries(${arg_NAME} PRIVATE ${arg_DEPENDS})
  if(arg_UNOPTIMIZED)
    groma_compile_unoptimized(${arg_NAME})
  endif()
endfunction()

# groma_test(NAME <name> SOURCES ... [DEPENDS ...] [DEFINITIONS ...] [LABELS ...] [SHARDS n] [TIMEOUT s]
#            [STATISTICS] [LONG pattern] [UNEMULATED pattern] [SLOW] [UNSANITIZED] [OPTIMIZED]):
#            a GoogleTest program.
# Each of its n shards is one CTest test: one process that runs every n-th case. A program with the label
# "long" is only built with GROMA_LONG_TESTS. So are the cases that match LONG (a GoogleTest filter), as a
# separate CTest test. SLOW: `scripts/test --quick` leaves it out. STATISTICS: the program does not run under
# a sanitizer, nor do cases named OverMany, because many drives execute no other code than one. UNSANITIZED:
# under a sanitizer the program runs only with GROMA_LONG_TESTS, as do the cases that match GROMA_UNSANITIZED,
# and in QEMU those that match UNEMULATED. OPTIMIZED, but not under a sanitizer: the test itself computes much.
function(groma_test)
  cmake_parse_arguments(arg "STATISTICS;SLOW;UNSANITIZED;OPTIMIZED" "NAME;TIMEOUT;SHARDS;LONG;UNEMULATED" "SOURCES;DEPENDS;DEFINITIONS;LABELS" ${ARGN})
  if(("long" IN_LIST arg_LABELS AND NOT GROMA_LONG_TESTS) OR (arg_STATISTICS AND GROMA_SANITIZE)
     OR (arg_UNSANITIZED AND GROMA_SANITIZE AND NOT GROMA_LONG_TESTS))
    return()
  endif()
  if(NOT arg_TIMEOUT)
    set(arg_TIMEOUT 300)
  endif()
  if(NOT arg_SHARDS)
    set(arg_SHARDS 1)
  endif()
  if(GROMA_SANITIZE OR GROMA_BARE_METAL)
    math(EXPR arg_TIMEOUT "3 * ${arg_TIMEOUT}")
  endif()
  list(APPEND arg_LABELS ${GROMA_TEST_LABELS})
  if(arg_SLOW)
    list(APPEND arg_LABELS slow)
  endif()
  add_executable(${arg_NAME} ${arg_SOURCES})
  # Replacements of operator new must be in their own unit, so that they are not inlined where it is called.
  set(support ${arg_SOURCES})
  list(FILTER support INCLUDE REGEX "/test/support/")
  set_source_files_properties(${support} PROPERTIES SKIP_UNITY_BUILD_INCLUSION ON)
  target_link_libraries(${arg_NAME} PRIVATE groma_build_options groma_test_options ${arg_DEPENDS} GTest::gtest GTest::gmock GTest::gtest_main)
  if(arg_OPTIMIZED AND NOT GROMA_SANITIZE)
    target_link_libraries(${arg_NAME} PRIVATE groma_little_optimized)
  else()
    target_link_libraries(${arg_NAME} PRIVATE groma_unoptimized)
  endif()
  target_compile_definitions(${arg_NAME} PRIVATE ${arg_DEFINITIONS})
  if(NOT GROMA_BARE_METAL AND (NOT arg_OPTIMIZED OR GROMA_SANITIZE))
    groma_prefer_their_instances_at_end(${arg_NAME})
    target_precompile_headers(${arg_NAME} REUSE_FROM groma_test_headers)
  endif()
  set(left_out "")
  if(GROMA_SANITIZE)
    string(APPEND left_out ":*OverMany*")
    if(NOT GROMA_LONG_TESTS)
      string(APPEND left_out ":${GROMA_UNSANITIZED}")
    endif()
  endif()
  if(arg_UNEMULATED AND GROMA_BARE_METAL AND NOT GROMA_LONG_TESTS)
    string(APPEND left_out ":${arg_UNEMULATED}")
  endif()
  if(arg_LONG)
    string(APPEND left_out ":${arg_LONG}")
  endif()
  # The longest tests start first, so that none runs alone at the end.
  set(cost ${arg_SHARDS})
  if(arg_SLOW)
    math(EXPR cost "${cost} + 10")
  endif()
  math(EXPR last "${arg_SHARDS} - 1")
  foreach(shard RANGE ${last})
    set(environment GTEST_TOTAL_SHARDS=${arg_SHARDS} GTEST_SHARD_INDEX=${shard} GTEST_FILTER=-${left_out})
    # A bare-metal program in QEMU gets its environment with its arguments, and cannot create a file.
    if(GROMA_BARE_METAL)
      add_test(NAME ${arg_NAME}.${shard} COMMAND ${arg_NAME} ${environment})
    else()
      add_test(
        NAME ${arg_NAME}.${shard}
        COMMAND ${arg_NAME} --gtest_brief=1 --gtest_output=xml:${CMAKE_BINARY_DIR}/results/${arg_NAME}.${shard}.xml
      )
    endif()
    set_tests_properties(
      ${arg_NAME}.${shard}
      PROPERTIES
        ENVIRONMENT "${environment}"
        COST ${cost}
        LABELS "${arg_LABELS}"
        TIMEOUT ${arg_TIMEOUT}
    )
  endforeach()
  if(arg_LONG AND GROMA_LONG_TESTS AND NOT GROMA_SANITIZE)
    add_test(
      NAME ${arg_NAME}.long
      COMMAND ${arg_NAME} --gtest_brief=1 --gtest_output=xml:${CMAKE_BINARY_DIR}/results/${arg_NAME}.long.xml
    )
    set_tests_properties(
      ${arg_NAME}.long
      PROPERTIES ENVIRONMENT "GTEST_FILTER=${arg_LONG}" LABELS "${arg_LABELS};long" TIMEOUT 900
    )
  endif()
endfunction()

# groma_campaign(NAME <name> SOURCES ... SHORT ... LONG ... [DEPENDS ...] [TIMEOUT s] [STATISTICS] [SLOW]
#                [OPTIMIZED]):
# the tests <name>_test and, long, <name> of the same sources; SHORT and LONG are their definitions; TIMEOUT
# is that of the long one.
function(groma_campaign)
  cmake_parse_arguments(arg "STATISTICS;SLOW;OPTIMIZED" "NAME;TIMEOUT" "SOURCES;DEPENDS;SHORT;LONG" ${ARGN})
  set(common SOURCES ${arg_SOURCES} DEPENDS ${arg_DEPENDS})
  foreach(option STATISTICS SLOW OPTIMIZED)
    if(arg_${option})
      list(APPEND common ${option})
    endif()
  endforeach()
  groma_test(NAME ${arg_NAME}_test ${common} DEFINITIONS ${arg_SHORT})
  groma_test(NAME ${arg_NAME} ${common} DEFINITIONS ${arg_LONG} LABELS long TIMEOUT ${arg_TIMEOUT})
endfunction()

# groma_benchmark(NAME <name> SOURCES ... [DEPENDS ...]): built with GROMA_LONG_TESTS or when requested by
# name, but not under a sanitizer.
function(groma_benchmark)
  if(GROMA_SANITIZE)
    return()
  endif()
  cmake_parse_arguments(arg "" "NAME" "SOURCES;DEPENDS" ${ARGN})
  add_executable(${arg_NAME} ${arg_SOURCES})
  if(NOT GROMA_LONG_TESTS)
    set_target_properties(${arg_NAME} PROPERTIES EXCLUDE_FROM_ALL ON)
  endif()
  target_link_libraries(${arg_NAME} PRIVATE groma_build_options ${arg_DEPENDS} benchmark::benchmark benchmark::benchmark_main)
endfunction()
