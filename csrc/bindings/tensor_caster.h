#pragma once

// Teaches the chosen binding package about TensorArgument; both ways end in the same TensorArgument::read.
#if defined(CONTROLMM_NANOBIND)

#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wconversion"  // in its headers, beyond our reach
#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>
#pragma GCC diagnostic pop

#include "tensor_argument.h"
namespace bindings = nanobind;
#define CONTROLMM_MODULE(name, m) NB_MODULE(name, m)
#define CONTROLMM_BINDINGS_NAME "nanobind"

namespace nanobind::detail {
template <>
struct type_caster<controlmm::TensorArgument> {
  static constexpr auto Name = const_name("Tensor");
  template <class T>
  using Cast = const controlmm::TensorArgument&;
  template <class T>
  static constexpr bool can_cast() {
    return true;
  }
  bool from_python(handle source, std::uint8_t, cleanup_list*) {
    if (value.read(source.ptr())) return true;
    throw python_error();
  }
  explicit operator const controlmm::TensorArgument&() { return value; }
  controlmm::TensorArgument value;
};
}  // namespace nanobind::detail

#else

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "tensor_argument.h"
namespace bindings = pybind11;
#define CONTROLMM_MODULE(name, m) PYBIND11_MODULE(name, m)
#define CONTROLMM_BINDINGS_NAME "pybind11"

namespace pybind11::detail {
template <>
struct type_caster<controlmm::TensorArgument> {
  static constexpr auto name = const_name("Tensor");
  template <class>
  using cast_op_type = const controlmm::TensorArgument&;
  bool load(handle source, bool) {
    if (value.read(source.ptr())) return true;
    throw error_already_set();
  }
  operator const controlmm::TensorArgument&() { return value; }
  controlmm::TensorArgument value;
};
}  // namespace pybind11::detail

#endif
