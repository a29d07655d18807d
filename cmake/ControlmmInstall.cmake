# The C++ library for other CMake projects: find_package(controlmm) gives the target controlmm::kernels.
include(CMakePackageConfigHelpers)
include(GNUInstallDirs)

install(TARGETS controlmm_kernels EXPORT controlmm_targets ARCHIVE DESTINATION ${CMAKE_INSTALL_LIBDIR})
install(DIRECTORY ${PROJECT_SOURCE_DIR}/csrc/include/controlmm DESTINATION ${CMAKE_INSTALL_INCLUDEDIR})
install(EXPORT controlmm_targets NAMESPACE controlmm::
  DESTINATION ${CMAKE_INSTALL_LIBDIR}/cmake/controlmm)
configure_package_config_file(${CMAKE_CURRENT_LIST_DIR}/controlmm-config.cmake.in
  ${PROJECT_BINARY_DIR}/controlmm-config.cmake INSTALL_DESTINATION ${CMAKE_INSTALL_LIBDIR}/cmake/controlmm)
write_basic_package_version_file(${PROJECT_BINARY_DIR}/controlmm-config-version.cmake
  COMPATIBILITY SameMinorVersion)
install(FILES
  ${PROJECT_BINARY_DIR}/controlmm-config.cmake
  ${PROJECT_BINARY_DIR}/controlmm-config-version.cmake
  DESTINATION ${CMAKE_INSTALL_LIBDIR}/cmake/controlmm)
