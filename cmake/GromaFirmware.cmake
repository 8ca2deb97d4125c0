# Compiles and links an image: no hosted library, no heap, no exceptions.
add_compile_options(
  -ffreestanding
  -ffunction-sections
  -fdata-sections
  -fno-math-errno
  # As on the host: an enumeration can hold any number that is received.
  -fno-short-enums
  $<$<COMPILE_LANGUAGE:CXX>:-fno-exceptions>
  $<$<COMPILE_LANGUAGE:CXX>:-fno-rtti>
  $<$<COMPILE_LANGUAGE:CXX>:-fno-threadsafe-statics>
  $<$<COMPILE_LANGUAGE:CXX>:-fno-use-cxa-atexit>
)

# groma_image(NAME <name> LINKER_SCRIPT <file> SOURCES ... [DEPENDS ...]): builds <name>.elf, .hex and .map in
# the root of the build, and prints the size.
function(groma_image)
  cmake_parse_arguments(arg "" "NAME;LINKER_SCRIPT" "SOURCES;DEPENDS" ${ARGN})
  set(stem ${CMAKE_BINARY_DIR}/${arg_NAME})
  groma_executable(NAME ${arg_NAME} SOURCES ${arg_SOURCES} DEPENDS ${arg_DEPENDS} m)
  set_target_properties(
    ${arg_NAME}
    PROPERTIES
      SUFFIX .elf
      RUNTIME_OUTPUT_DIRECTORY ${CMAKE_BINARY_DIR}
      LINK_DEPENDS ${arg_LINKER_SCRIPT}
      # The C driver, because Debian has the additional libraries of the C++ one in a package of 1.6 GB.
      LINKER_LANGUAGE C
  )
  target_link_options(
    ${arg_NAME}
    PRIVATE
      -nostartfiles
      --specs=nano.specs
      -Wl,--script=${arg_LINKER_SCRIPT}
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
