# The extension module controlmm._core, through either binding package from the same sources.
set(extension_sources
  ${PROJECT_SOURCE_DIR}/csrc/bindings/module.cpp
  ${PROJECT_SOURCE_DIR}/csrc/bindings/tensor_argument.cpp)

if(CONTROLMM_BINDINGS STREQUAL "pybind11")
  set(PYBIND11_FINDPYTHON ON)
  find_package(pybind11 CONFIG REQUIRED)
  pybind11_add_module(_core MODULE ${extension_sources})
elseif(CONTROLMM_BINDINGS STREQUAL "nanobind")
  # Under a limited API (Python 3.12 and later) one wheel serves every version.
  if(SKBUILD_SABI_COMPONENT)
    find_package(Python 3.12 REQUIRED COMPONENTS Interpreter Development.Module ${SKBUILD_SABI_COMPONENT})
    set(stable_abi STABLE_ABI)
  else()
    find_package(Python 3.11 REQUIRED COMPONENTS Interpreter Development.Module)
  endif()
  find_package(nanobind CONFIG REQUIRED)
  nanobind_add_module(_core ${stable_abi} NB_STATIC ${extension_sources})
  target_compile_definitions(_core PRIVATE CONTROLMM_NANOBIND)
else()
  message(FATAL_ERROR "CONTROLMM_BINDINGS must be pybind11 or nanobind, got '${CONTROLMM_BINDINGS}'.")
endif()

target_link_libraries(_core PRIVATE controlmm::kernels controlmm_flags)
install(TARGETS _core LIBRARY DESTINATION controlmm COMPONENT python)
