#include "checks.h"

#include <algorithm>
#include <utility>
#include <vector>

namespace controlmm::checks {
namespace {

const char* dtype_text(DType dtype) {
  switch (dtype) {
    case DType::float32:
      return "float32";
    case DType::float64:
      return "float64";
    case DType::int64:
      return "int64";
    case DType::boolean:
      return "bool";
    default:
      return "an unsupported dtype";
  }
}

std::uintptr_t bytes_of(DType dtype) {
  if (dtype == DType::boolean) return 1;
  return dtype == DType::float32 ? 4 : 8;
}

[[noreturn]] void refuse(const char* name, const std::string& expected, const std::string& got) {
  throw std::invalid_argument(std::string("`") + name + "` must " + expected + ", got " + got + ".");
}

std::string shape_text(std::initializer_list<std::int64_t> shape) {
  std::string text = "(";
  for (std::int64_t extent : shape) text += std::to_string(extent) + ", ";
  if (text.size() > 1) text.resize(text.size() - (shape.size() == 1 ? 1 : 2));
  return text + ")";
}

}  // namespace

std::string shape_text(const TensorView& view) {
  std::string text = "(";
  for (int i = 0; i < view.ndim; ++i)
    text += std::to_string(view.shape[i]) + (i + 1 < view.ndim ? ", " : view.ndim == 1 ? "," : "");
  return text + ")";
}

void require(const TensorView& view, const char* name, int ndim, DType dtype) {
  if (view.ndim != ndim) refuse(name, "have " + std::to_string(ndim) + " dimensions", "shape " + shape_text(view));
  if (view.dtype != dtype) refuse(name, std::string("be ") + dtype_text(dtype), dtype_text(view.dtype));
  if (reinterpret_cast<std::uintptr_t>(view.data) % bytes_of(dtype) != 0)
    refuse(name, "lie at a multiple of its element size in memory (copy it first)", "a misaligned address");
}

void require_shape(const TensorView& view, const char* name, std::initializer_list<std::int64_t> shape) {
  const bool fits = view.ndim == static_cast<int>(shape.size()) && std::equal(shape.begin(), shape.end(), view.shape);
  if (!fits) refuse(name, "have shape " + shape_text(shape), shape_text(view));
}

void require_contiguous(const TensorView& view, const char* name) {
  std::int64_t expected = 1;
  for (int i = view.ndim - 1; i >= 0; --i) {
    if (view.size() != 0 && view.shape[i] != 1 && view.strides[i] != expected)
      refuse(name, "be contiguous", "other strides");
    expected *= view.shape[i];
  }
}

void require_row_major(const TensorView& view, const char* name) {
  if (view.is_read_only) refuse(name, "be writable", "read-only memory");
  require_contiguous(view, name);
}

void require_distinct_elements(const TensorView& view, const char* name) {
  if (view.is_read_only) refuse(name, "be writable", "read-only memory");
  if (view.size() == 0) return;
  std::vector<std::pair<std::int64_t, std::int64_t>> axes;  // stride, extent
  for (int i = 0; i < view.ndim; ++i)
    if (view.shape[i] > 1) axes.emplace_back(std::abs(view.strides[i]), view.shape[i]);
  std::sort(axes.begin(), axes.end());
  std::int64_t reach = 0;  // distance from the first to the last element of the axes so far
  for (const auto& [stride, extent] : axes) {
    if (stride <= reach) refuse(name, "not place two elements at one address", "overlapping strides");
    reach += stride * (extent - 1);
  }
}

}  // namespace controlmm::checks
