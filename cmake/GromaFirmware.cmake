# Compiles and links an image: no hosted library, no heap, no exceptions.
add_compile_options(
  -ffreestanding
  -ffunction-sections
  -fdata-sections
  -fno-math-errno
  # As on the host: an enumeration can hold any number that is received.
  -fno-short-enums
  # GCC inlines a function that is defined in its class up to a size of 70, others up to 15.
  $<$<COMPILE_LANGUAGE:CXX>:--param=max-inline-insns-single=20>
  $<$<COMPILE_LANGUAGE:CXX>:-fno-exceptions>
  $<$<COMPILE_LANGUAGE:CXX>:-fno-rtti>
  $<$<COMPILE_LANGUAGE:CXX>:-fno-threadsafe-statics>
  $<$<COMPILE_LANGUAGE:CXX>:-fno-use-cxa-atexit>
)

# groma_image(NAME <name> LINKER_SCRIPTS <file> ... SOURCES ... [DEPENDS ...]): builds <name>.elf, .hex and .map
# in the root of the build, and prints the size. The first script includes the others by their paths from the
# root of the sources.
function(groma_image)
  cmake_parse_arguments(arg "" "NAME" "LINKER_SCRIPTS;SOURCES;DEPENDS" ${ARGN})
  set(stem ${CMAKE_BINARY_DIR}/${arg_NAME})
  list(GET arg_LINKER_SCRIPTS 0 script)
  groma_executable(NAME ${arg_NAME} SOURCES ${arg_SOURCES} DEPENDS ${arg_DEPENDS} m)
  set_target_properties(
    ${arg_NAME}
    PROPERTIES
      SUFFIX .elf
      RUNTIME_OUTPUT_DIRECTORY ${CMAKE_BINARY_DIR}
      LINK_DEPENDS "${arg_LINKER_SCRIPTS}"
      # The C driver, because Debian has the additional libraries of the C++ one in a package of 1.6 GB.
      LINKER_LANGUAGE C
  )
  target_link_options(
    ${arg_NAME}
    PRIVATE
      -nostartfiles
      --specs=nano.specs
      -L${CMAKE_SOURCE_DIR}
      -Wl,--script=${script}
      -Wl,--gc-sections
      -Wl,--fatal-warnings
      -Wl,--no-enum-size-warning
      -Wl,-Map=${stem}.map
  )
  add_custom_command(
    TARGET ${arg_NAME}
    POST_BUILD
    COMMAND ${CMAKE_OBJCOPY} -O ihex ${stem}.elf ${stem}.hex
    COMMAND arm-none-eabi-size ${stem}.elf
    BYPRODUCTS ${stem}.hex ${stem}.map
    VERBATIM
  )
endfunction()
