#include "tensor_argument.h"

#include <cstring>

#include "dlpack.h"

namespace controlmm {
namespace {

DType dtype_of(const dlpack::DataType& type) {
  if (type.lanes != 1) return DType::unsupported;
  if (type.code == dlpack::kFloat && type.bits == 32) return DType::float32;
  if (type.code == dlpack::kFloat && type.bits == 64) return DType::float64;
  if (type.code == dlpack::kInt && type.bits == 64) return DType::int64;
  if (type.code == dlpack::kBool && type.bits == 8) return DType::boolean;
  return DType::unsupported;
}

bool fill_view(const dlpack::Tensor& tensor, TensorView& view) {
  if (tensor.device.type != dlpack::kCpu) {
    PyErr_SetString(PyExc_TypeError, "a tensor must be in CPU memory for the native kernels; call .cpu() first.");
    return false;
  }
  if (tensor.ndim > kMaxDims) {
    PyErr_Format(PyExc_ValueError, "a tensor must have at most %d dimensions, got %d.", kMaxDims, int{tensor.ndim});
    return false;
  }
  view.data = static_cast<char*>(tensor.data) + tensor.byte_offset;
  view.ndim = tensor.ndim;
  view.dtype = dtype_of(tensor.dtype);
  std::int64_t row_major_stride = 1;
  for (int i = tensor.ndim - 1; i >= 0; --i) {
    view.shape[i] = tensor.shape[i];
    view.strides[i] = tensor.strides != nullptr ? tensor.strides[i] : row_major_stride;
    row_major_stride *= tensor.shape[i];
  }
  return true;
}

using FromObject = int (*)(void*, dlpack::Tensor*);

// Asks a type for its exchange table; null if it has none that we can read.
FromObject lookup_exchange(PyTypeObject* type) {
  PyObject* capsule = PyObject_GetAttrString(reinterpret_cast<PyObject*>(type), "__dlpack_c_exchange_api__");
  if (capsule == nullptr) {
    PyErr_Clear();
    return nullptr;
  }
  auto* api = static_cast<dlpack::ExchangeApi*>(PyCapsule_GetPointer(capsule, "dlpack_exchange_api"));
  if (api == nullptr) PyErr_Clear();
  Py_DECREF(capsule);  // the table is static in the producer
  while (api != nullptr && api->version.major != 1) api = api->previous;
  return api == nullptr ? nullptr : api->tensor_from_object;
}

// Types hardly ever change between calls, so the last answer is kept. Holding the type keeps its address unique.
// One slot a thread: no lock, also right without a GIL.
FromObject exchange_of(PyTypeObject* type) {
  static thread_local PyTypeObject* last_type = nullptr;
  static thread_local FromObject last = nullptr;
  if (type == last_type) return last;
  last = lookup_exchange(type);
  Py_INCREF(reinterpret_cast<PyObject*>(type));
  Py_XDECREF(reinterpret_cast<PyObject*>(last_type));
  last_type = type;
  return last;
}

PyObject* call_dlpack(PyObject* object) {
  PyObject* method = PyObject_GetAttrString(object, "__dlpack__");
  if (method == nullptr) {
    PyErr_Clear();
    PyErr_SetString(PyExc_TypeError, "a tensor was expected (an object with `__dlpack__`), got something else.");
    return nullptr;
  }
  PyObject* no_arguments = PyTuple_New(0);
  PyObject* keywords = Py_BuildValue("{s:(ii)}", "max_version", 1, 0);
  PyObject* capsule = PyObject_Call(method, no_arguments, keywords);
  if (capsule == nullptr && PyErr_ExceptionMatches(PyExc_TypeError)) {
    PyErr_Clear();  // a producer from before DLPack 1.0 knows no `max_version`
    capsule = PyObject_Call(method, no_arguments, nullptr);
  }
  Py_XDECREF(keywords);
  Py_DECREF(no_arguments);
  Py_DECREF(method);
  return capsule;
}

}  // namespace

bool TensorArgument::read(PyObject* object) {
  if (FromObject from_object = exchange_of(Py_TYPE(object)); from_object != nullptr) {
    dlpack::Tensor tensor;
    return from_object(object, &tensor) == 0 && fill_view(tensor, view_);
  }
  return read_capsule(object);
}

// The capsule is left unconsumed: its own destructor frees the memory when this argument lets go of it.
bool TensorArgument::read_capsule(PyObject* object) {
  owner_ = call_dlpack(object);
  if (owner_ == nullptr) return false;
  if (PyCapsule_IsValid(owner_, "dltensor_versioned")) {
    auto* managed = static_cast<dlpack::VersionedTensor*>(PyCapsule_GetPointer(owner_, "dltensor_versioned"));
    if (managed->version.major != 1) {
      PyErr_SetString(PyExc_TypeError, "a tensor must come as DLPack 1.x, got another major version.");
      return false;
    }
    view_.is_read_only = (managed->flags & dlpack::kReadOnlyFlag) != 0;
    return fill_view(managed->tensor, view_);
  }
  auto* tensor = static_cast<dlpack::Tensor*>(PyCapsule_GetPointer(owner_, "dltensor"));
  return tensor != nullptr && fill_view(*tensor, view_);
}

}  // namespace controlmm
