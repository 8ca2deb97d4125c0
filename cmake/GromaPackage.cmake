# `cpack --preset release` (or arm64): a Debian package with groma, gromad, its unit, user and configuration, udev
# rules, manual pages, completions and the schema of the configuration. docs/how-to/install-gromad.md describes it.

# Texts that follow from the definitions in the programs; a cross build prints them by its emulator.
set(generated ${CMAKE_BINARY_DIR}/package)
file(MAKE_DIRECTORY ${generated})
set(texts "")
function(groma_printed program format file)
  add_custom_command(
    OUTPUT ${generated}/${file}
    COMMAND ${program} --print-reference ${format} > ${generated}/${file}
    DEPENDS ${program}
  )
  set(texts ${texts} ${generated}/${file} PARENT_SCOPE)
endfunction()
groma_printed(groma man groma.1)
groma_printed(groma bash groma)
groma_printed(groma zsh _groma)
groma_printed(gromad man gromad.8)
groma_printed(gromad bash gromad)
groma_printed(gromad zsh _gromad)
groma_printed(gromad schema gromad.schema.json)

# Debian wants manual pages and the list of changes compressed, without a time.
function(groma_compressed source file)
  add_custom_command(OUTPUT ${generated}/${file}.gz COMMAND gzip -9nc ${source} > ${generated}/${file}.gz DEPENDS ${source})
  set(texts ${texts} ${generated}/${file}.gz PARENT_SCOPE)
endfunction()
groma_compressed(${generated}/groma.1 groma.1)
groma_compressed(${generated}/gromad.8 gromad.8)
groma_compressed(${CMAKE_SOURCE_DIR}/CHANGELOG.md changelog)
add_custom_target(package_texts ALL DEPENDS ${texts})

# Files of the system: never part of `cmake --install` without `--component system`.
set(system COMPONENT system EXCLUDE_FROM_ALL)
set(doc share/doc/groma)
install(FILES ${generated}/groma.1.gz DESTINATION share/man/man1 ${system})
install(FILES ${generated}/gromad.8.gz DESTINATION share/man/man8 ${system})
install(FILES ${generated}/groma ${generated}/gromad DESTINATION share/bash-completion/completions ${system})
install(FILES ${generated}/_groma ${generated}/_gromad DESTINATION share/zsh/vendor-completions ${system})
install(FILES ${generated}/gromad.schema.json DESTINATION share/groma ${system})
install(FILES ${generated}/changelog.gz packaging/copyright DESTINATION ${doc} ${system})
install(FILES docs/reference/gromad.md docs/reference/messages.md DESTINATION ${doc} ${system})
install(FILES packaging/gromad.service DESTINATION lib/systemd/system ${system})
install(FILES packaging/sysusers.conf DESTINATION lib/sysusers.d RENAME groma.conf ${system})
install(FILES packaging/tmpfiles.conf DESTINATION lib/tmpfiles.d RENAME groma.conf ${system})
install(FILES host/provision/60-groma.rules DESTINATION lib/udev/rules.d ${system})
install(FILES packaging/gromad.yaml DESTINATION /etc/groma ${system})

set(CPACK_GENERATOR DEB)
set(CPACK_PACKAGE_NAME groma)
set(CPACK_PACKAGE_DIRECTORY ${CMAKE_BINARY_DIR}/packages)
set(CPACK_PACKAGING_INSTALL_PREFIX /usr)
set(CPACK_INSTALL_CMAKE_PROJECTS
    "${CMAKE_BINARY_DIR};${PROJECT_NAME};programs;/;${CMAKE_BINARY_DIR};${PROJECT_NAME};system;/"
)
set(CPACK_INSTALL_DEFAULT_DIRECTORY_PERMISSIONS OWNER_READ OWNER_WRITE OWNER_EXECUTE GROUP_READ GROUP_EXECUTE WORLD_READ WORLD_EXECUTE)
# binutils cannot strip programs of another processor; the toolchain links those without symbols.
if(NOT CMAKE_CROSSCOMPILING)
  set(CPACK_STRIP_FILES ON)
endif()
set(CPACK_DEBIAN_FILE_NAME DEB-DEFAULT)
set(CPACK_DEBIAN_COMPRESSION_TYPE xz)
set(CPACK_DEBIAN_PACKAGE_ARCHITECTURE amd64)
if(CMAKE_SYSTEM_PROCESSOR STREQUAL aarch64)
  set(CPACK_DEBIAN_PACKAGE_ARCHITECTURE arm64)
endif()
set(CPACK_DEBIAN_PACKAGE_MAINTAINER "No maintainer yet (placeholder) <nobody@groma.invalid>")
set(CPACK_DEBIAN_PACKAGE_SECTION misc)
set(CPACK_PACKAGE_DESCRIPTION_SUMMARY "UWB localization for industrial ground robots")
set(CPACK_PACKAGE_DESCRIPTION
    "groma calibrates, replays and evaluates; gromad localizes a robot from UWB
 ranges and its odometry, and serves its pose. Not a safety device."
)
# What dpkg-shlibdeps finds; it knows only the libraries of this machine's processor. package_test compares.
set(dds "")
if(GROMA_HAS_ROS2)
  set(dds "libddsc0debian (>= 0.8.0)")
endif()
string(
  JOIN ", " CPACK_DEBIAN_PACKAGE_DEPENDS
  "libc6 (>= 2.35)"
  ${dds}
  "libfmt9 (>= 9.1.0+ds1)"
  "libgcc-s1 (>= 3.0)"
  "liblz4-1 (>= 0.0~r127)"
  "libmatio11 (>= 1.5.4)"
  "libserialport0"
  "libsqlite3-0 (>= 3.6.1)"
  "libssl3 (>= 3.0.0)"
  "libstdc++6 (>= 12)"
  "libunicorn2 (>= 2.0.1.post1)"
  "libyaml-cpp0.7 (>= 0.7.0)"
  "libzstd1 (>= 1.5.2)"
  "systemd | systemd-standalone-sysusers | systemd-sysusers"
)
set(scripts ${CMAKE_SOURCE_DIR}/packaging)
file(WRITE ${generated}/conffiles "/etc/groma/gromad.yaml\n")
set(CPACK_DEBIAN_PACKAGE_CONTROL_EXTRA ${scripts}/postinst ${scripts}/prerm ${scripts}/postrm ${generated}/conffiles)
set(CPACK_DEBIAN_PACKAGE_CONTROL_STRICT_PERMISSION ON)
include(CPack)
