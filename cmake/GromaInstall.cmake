# `cmake --install`: the programs, and the estimators as a library for find_package(groma) and pkg-config. Its headers
# are those of four folders of host/, installed below include/groma and included as <groma/filter/filter.hpp>.
include(CMakePackageConfigHelpers)
include(GNUInstallDirs)

set(libraries model filter calibration evaluation)
set(package_folder ${CMAKE_INSTALL_LIBDIR}/cmake/groma)

foreach(library IN LISTS libraries)
  set_target_properties(groma_${library} PROPERTIES EXPORT_NAME ${library})
  target_compile_features(groma_${library} PUBLIC cxx_std_20)
  target_include_directories(groma_${library} INTERFACE $<INSTALL_INTERFACE:${CMAKE_INSTALL_INCLUDEDIR}>)
  install(TARGETS groma_${library} EXPORT groma ARCHIVE COMPONENT library)
endforeach()

install(
  CODE "
    set(source ${CMAKE_SOURCE_DIR}/host)
    set(target \$ENV{DESTDIR}\${CMAKE_INSTALL_PREFIX}/${CMAKE_INSTALL_INCLUDEDIR}/groma)
    set(folders ${libraries})
    include(${CMAKE_SOURCE_DIR}/cmake/InstallHeaders.cmake)"
  COMPONENT library
)

configure_package_config_file(
  cmake/groma-config.cmake.in ${CMAKE_BINARY_DIR}/groma-config.cmake INSTALL_DESTINATION ${package_folder}
)
write_basic_package_version_file(${CMAKE_BINARY_DIR}/groma-config-version.cmake COMPATIBILITY SameMinorVersion)
install(
  FILES ${CMAKE_BINARY_DIR}/groma-config.cmake ${CMAKE_BINARY_DIR}/groma-config-version.cmake
  DESTINATION ${package_folder}
  COMPONENT library
)
install(EXPORT groma NAMESPACE groma:: FILE groma-targets.cmake DESTINATION ${package_folder} COMPONENT library)

configure_file(cmake/groma.pc.in groma.pc @ONLY)
install(FILES ${CMAKE_BINARY_DIR}/groma.pc DESTINATION ${CMAKE_INSTALL_LIBDIR}/pkgconfig COMPONENT library)

install(TARGETS groma gromad RUNTIME COMPONENT programs)
