#include "tensor_caster.h"

#include <stdexcept>

#include "controlmm/dispatch.h"
#include "controlmm/kernels.h"

namespace controlmm {
namespace {

using Arg = const TensorArgument&;

Norm norm_of(int code) {
  if (code < 0 || code > 2) throw std::invalid_argument("`norm` must be 0 (l2), 1 (l1) or 2 (mse).");
  return static_cast<Norm>(code);
}

const char* bindings_name() { return CONTROLMM_BINDINGS_NAME; }

// One list for both binding packages. Kernels run without the GIL.
template <class Module>
void register_kernels(Module& m) {
  using Unlocked = bindings::call_guard<bindings::gil_scoped_release>;
  m.def("version", &version);
  m.def("compiler", &compiler);
  m.def("bindings", &bindings_name);
  m.def("available_isas", &available_isas);
  m.def("active_isa", &active_isa);
  m.def("set_isa", &set_isa);

  m.def("recover_joints", [](Arg features, Arg joints, int threads) {
    recover_joints(features.view(), joints.view(), threads);
  }, Unlocked());
  m.def("recover_joints_backward", [](Arg features, Arg grad_joints, Arg grad_features, int threads) {
    recover_joints_backward(features.view(), grad_joints.view(), grad_features.view(), threads);
  }, Unlocked());
  m.def("masked_consistency_loss",
        [](Arg joints, Arg targets, Arg mask, int norm, Arg loss, Arg counts, int threads) {
          masked_consistency_loss(joints.view(), targets.view(), mask.view(), norm_of(norm), loss.view(),
                                  counts.view(), threads);
        }, Unlocked());
  m.def("masked_consistency_loss_backward",
        [](Arg joints, Arg targets, Arg mask, int norm, Arg grad_loss, Arg counts, Arg grad_joints, int threads) {
          masked_consistency_loss_backward(joints.view(), targets.view(), mask.view(), norm_of(norm),
                                           grad_loss.view(), counts.view(), grad_joints.view(), threads);
        }, Unlocked());
}

}  // namespace
}  // namespace controlmm

CONTROLMM_MODULE(_core, m) { controlmm::register_kernels(m); }
