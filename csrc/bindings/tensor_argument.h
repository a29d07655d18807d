#pragma once

#include <Python.h>

#include "controlmm/tensor_view.h"

namespace controlmm {

/// A tensor received from Python: a view and, for producers without the fast path, what keeps its memory alive.
class TensorArgument {
 public:
  TensorArgument() = default;
  TensorArgument(const TensorArgument&) = delete;
  TensorArgument& operator=(const TensorArgument&) = delete;
  ~TensorArgument() { Py_XDECREF(owner_); }

  /// Reads any object of the DLPack protocol without copying. Needs the GIL.
  /// Returns false, with a Python error set, if the object is no CPU tensor of a supported kind.
  bool read(PyObject* object);

  const TensorView& view() const { return view_; }

 private:
  bool read_capsule(PyObject* object);

  TensorView view_;
  PyObject* owner_ = nullptr;
};

}  // namespace controlmm
