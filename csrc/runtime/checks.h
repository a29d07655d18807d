#pragma once

#include <stdexcept>
#include <string>

#include "kernel_table.h"

namespace controlmm::checks {

std::string shape_text(const TensorView& view);

/// Checks number of dimensions, dtype and alignment; every message names the argument.
void require(const TensorView& view, const char* name, int ndim, DType dtype);
void require_shape(const TensorView& view, const char* name, std::initializer_list<std::int64_t> shape);
/// For outputs: writable, and row-major unless it is empty.
void require_row_major(const TensorView& view, const char* name);
/// For outputs with free strides: writable, no two elements in one place.
void require_distinct_elements(const TensorView& view, const char* name);

/// For inputs that the kernels read as a plain array.
void require_contiguous(const TensorView& view, const char* name);

/// Calls `run(T{})` with float or double for the dtype of the named argument.
template <class F>
void for_dtype(const TensorView& view, const char* name, F run) {
  if (view.dtype == DType::float32) return run(float{});
  if (view.dtype == DType::float64) return run(double{});
  throw std::invalid_argument(std::string("`") + name + "` must be float32 or float64. Convert it first.");
}

template <class T>
Strided3<T> strided3(const TensorView& v) {
  return {static_cast<T*>(v.data), v.strides[0], v.strides[1], v.strides[2]};
}
template <class T>
Strided4<T> strided4(const TensorView& v) {
  return {static_cast<T*>(v.data), v.strides[0], v.strides[1], v.strides[2], v.strides[3]};
}

/// Strides for an axis order of the caller's choice, with those of extents of 1 set to 0 so that they broadcast.
template <class T>
Strided4<T> broadcast4(const TensorView& v, int clip, int frame, int joint, int coord) {
  const auto stride = [&](int axis) { return v.shape[axis] == 1 ? 0 : v.strides[axis]; };
  return {static_cast<T*>(v.data), stride(clip), stride(frame), stride(joint), stride(coord)};
}

}  // namespace controlmm::checks
