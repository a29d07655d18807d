# The C++ library: kernels, one object file for each instruction set, and the code that chooses among them.
find_package(Threads REQUIRED)
set(csrc "${PROJECT_SOURCE_DIR}/csrc")

add_library(controlmm_kernels STATIC
  ${csrc}/runtime/checks.cpp
  ${csrc}/runtime/consistency.cpp
  ${csrc}/runtime/cpu_features.cpp
  ${csrc}/runtime/dispatch.cpp
  ${csrc}/runtime/exact.cpp
  ${csrc}/runtime/guidance.cpp
  ${csrc}/runtime/gumbel.cpp
  ${csrc}/runtime/kinematics.cpp
  ${csrc}/runtime/obstacle_arguments.cpp
  ${csrc}/runtime/obstacles.cpp
  ${csrc}/runtime/parallel.cpp
  ${csrc}/runtime/winograd.cpp)
add_library(controlmm::kernels ALIAS controlmm_kernels)
set_target_properties(controlmm_kernels PROPERTIES POSITION_INDEPENDENT_CODE ON EXPORT_NAME kernels)
target_compile_definitions(controlmm_kernels PRIVATE CONTROLMM_VERSION="${PROJECT_VERSION}")
target_compile_features(controlmm_kernels PUBLIC cxx_std_17)
target_link_libraries(controlmm_kernels PRIVATE $<BUILD_INTERFACE:controlmm_flags> PUBLIC Threads::Threads)
target_include_directories(controlmm_kernels
  PUBLIC $<BUILD_INTERFACE:${csrc}/include> $<INSTALL_INTERFACE:include>
  PRIVATE ${csrc}/kernels ${csrc}/runtime)

# Only these files see newer instructions; everything else runs on any processor.
function(controlmm_add_isa name)
  target_sources(controlmm_kernels PRIVATE ${csrc}/kernels/isa_${name}.cpp)
  set_source_files_properties(${csrc}/kernels/isa_${name}.cpp PROPERTIES COMPILE_OPTIONS "${ARGN}")
  set_property(SOURCE ${csrc}/kernels/isa_${name}.cpp APPEND PROPERTY OBJECT_DEPENDS "${inl_files}")
endfunction()
file(GLOB inl_files CONFIGURE_DEPENDS ${csrc}/kernels/*.inl)

# Optimised for speed whatever the build type; with sanitizers compile time counts more.
if(CONTROLMM_SANITIZE)
  set(isa_flags -O1 -g0)
else()
  set(isa_flags $<$<NOT:$<CONFIG:Debug>>:-O3>)
endif()
if(CMAKE_SYSTEM_PROCESSOR MATCHES "x86_64|AMD64")
  controlmm_add_isa(baseline ${isa_flags})
  controlmm_add_isa(avx2 ${isa_flags} -mavx2 -mfma)
  controlmm_add_isa(avx512 ${isa_flags} -mavx512f -mavx512dq -mavx512bw -mavx512vl -mfma
                    -mprefer-vector-width=512)
elseif(CMAKE_SYSTEM_PROCESSOR MATCHES "aarch64|arm64")
  controlmm_add_isa(neon ${isa_flags})
else()
  message(FATAL_ERROR "The kernels know x86-64 and 64-bit ARM, not ${CMAKE_SYSTEM_PROCESSOR}.")
endif()
