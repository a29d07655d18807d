#pragma once

#include <cstddef>
#include <cstdint>
#include <initializer_list>

namespace controlmm {

enum class DType : std::uint8_t { float32, float64, int64, boolean, unsupported };

constexpr int kMaxDims = 6;

/// A borrowed n-dimensional array: where it is and how to walk it. Owns nothing and never frees.
/// Strides count elements, may be zero (broadcast) or negative.
struct TensorView {
  void* data = nullptr;
  int ndim = 0;
  std::int64_t shape[kMaxDims] = {};
  std::int64_t strides[kMaxDims] = {};
  DType dtype = DType::unsupported;
  bool is_read_only = false;

  template <class T>
  T* as() const {
    return static_cast<T*>(data);
  }

  std::int64_t size() const {
    std::int64_t total = 1;
    for (int i = 0; i < ndim; ++i) total *= shape[i];
    return total;
  }
};

namespace detail {
template <class T>
struct DTypeOf;
template <>
struct DTypeOf<float> {
  static constexpr DType value = DType::float32;
};
template <>
struct DTypeOf<double> {
  static constexpr DType value = DType::float64;
};
template <>
struct DTypeOf<std::int64_t> {
  static constexpr DType value = DType::int64;
};
template <>
struct DTypeOf<bool> {
  static constexpr DType value = DType::boolean;
};
}  // namespace detail

/// A view of row-major memory. `data` must stay alive and hold the product of `shape` elements.
template <class T>
TensorView row_major(T* data, std::initializer_list<std::int64_t> shape) {
  TensorView view;
  view.data = data;
  view.dtype = detail::DTypeOf<T>::value;
  view.ndim = static_cast<int>(shape.size());
  int i = 0;
  for (std::int64_t extent : shape) view.shape[i++] = extent;
  std::int64_t stride = 1;
  for (i = view.ndim - 1; i >= 0; --i) {
    view.strides[i] = stride;
    stride *= view.shape[i];
  }
  return view;
}

/// Same for memory that must not be written; giving it as an output is refused.
template <class T>
TensorView row_major(const T* data, std::initializer_list<std::int64_t> shape) {
  TensorView view = row_major(const_cast<T*>(data), shape);
  view.is_read_only = true;
  return view;
}

}  // namespace controlmm
