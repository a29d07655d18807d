#include <stdexcept>

#include "controlmm/dispatch.h"
#include "controlmm/kernels.h"
#include "tensor_caster.h"

namespace controlmm {
namespace {

using Arg = const TensorArgument&;

Norm norm_of(int code) {
  if (code < 0 || code > 2) throw std::invalid_argument("`norm` must be 0 (l2), 1 (l1) or 2 (mse).");
  return static_cast<Norm>(code);
}

Obstacles obstacles_of(Arg kinds, Arg parameters, Arg heights) {
  return {kinds.view(), parameters.view(), heights.view()};
}

Clearance clearance_of(Arg radii, Arg is_active, Arg lengths, double margin, bool is_mean) {
  return {radii.view(), is_active.view(), lengths.view(), margin, is_mean};
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

  m.def(
      "recover_joints",
      [](Arg features, Arg joints, int threads) { recover_joints(features.view(), joints.view(), threads); },
      Unlocked());
  m.def(
      "recover_joints_backward",
      [](Arg features, Arg grad_joints, Arg grad_features, int threads) {
        recover_joints_backward(features.view(), grad_joints.view(), grad_features.view(), threads);
      },
      Unlocked());
  m.def(
      "masked_consistency_loss",
      [](Arg joints, Arg targets, Arg mask, int norm, Arg loss, Arg counts, int threads) {
        masked_consistency_loss(joints.view(), targets.view(), mask.view(), norm_of(norm), loss.view(), counts.view(),
                                threads);
      },
      Unlocked());
  m.def(
      "masked_consistency_loss_backward",
      [](Arg joints, Arg targets, Arg mask, int norm, Arg grad_loss, Arg counts, Arg grad_joints, int threads) {
        masked_consistency_loss_backward(joints.view(), targets.view(), mask.view(), norm_of(norm), grad_loss.view(),
                                         counts.view(), grad_joints.view(), threads);
      },
      Unlocked());
  m.def(
      "obstacle_loss",
      [](Arg joints, Arg kinds, Arg parameters, Arg heights, Arg radii, Arg is_active, Arg lengths, double margin,
         bool is_mean, Arg loss, int threads) {
        obstacle_loss(joints.view(), obstacles_of(kinds, parameters, heights),
                      clearance_of(radii, is_active, lengths, margin, is_mean), loss.view(), threads);
      },
      Unlocked());
  m.def(
      "obstacle_loss_backward",
      [](Arg joints, Arg kinds, Arg parameters, Arg heights, Arg radii, Arg is_active, Arg lengths, double margin,
         bool is_mean, Arg grad_loss, Arg grad_joints, int threads) {
        obstacle_loss_backward(joints.view(), obstacles_of(kinds, parameters, heights),
                               clearance_of(radii, is_active, lengths, margin, is_mean), grad_loss.view(),
                               grad_joints.view(), threads);
      },
      Unlocked());
  m.def(
      "guidance_value_and_grad",
      [](Arg decoded, Arg mean, Arg std, Arg targets, Arg mask, int norm, Arg kinds, Arg parameters, Arg heights,
         Arg radii, Arg is_active, Arg lengths, double margin, bool is_mean, double obstacle_weight, Arg loss,
         Arg gradient, int threads) {
        guidance_value_and_grad(decoded.view(), mean.view(), std.view(), targets.view(), mask.view(), norm_of(norm),
                                obstacles_of(kinds, parameters, heights),
                                clearance_of(radii, is_active, lengths, margin, is_mean), obstacle_weight, loss.view(),
                                gradient.view(), threads);
      },
      Unlocked());
  m.def(
      "control_value_and_grad",
      [](Arg decoded, Arg mean, Arg std, Arg targets, Arg mask, int norm, Arg loss, Arg gradient, int threads) {
        guidance_value_and_grad(decoded.view(), mean.view(), std.view(), targets.view(), mask.view(), norm_of(norm),
                                loss.view(), gradient.view(), threads);
      },
      Unlocked());
  m.def(
      "gumbel_noise",
      [](std::uint64_t seed, std::int64_t first_clip, Arg noise, int threads) {
        gumbel_noise({seed, first_clip}, noise.view(), threads);
      },
      Unlocked());
  m.def(
      "gumbel_straight_through",
      [](Arg logits, Arg codebook, double temperature, std::uint64_t seed, std::int64_t first_clip, Arg ids,
         Arg embeddings, Arg probabilities, int threads) {
        gumbel_straight_through(logits.view(), codebook.view(), temperature, {seed, first_clip}, ids.view(),
                                embeddings.view(), probabilities.view(), threads);
      },
      Unlocked());
  m.def(
      "softmax_backward",
      [](Arg probabilities, double temperature, Arg gradient, int threads) {
        softmax_backward(probabilities.view(), temperature, gradient.view(), threads);
      },
      Unlocked());
  m.def(
      "project_change",
      [](Arg parents, Arg held, Arg planted, double stiffness, double smoothness, double standing, Arg change) {
        project_change(parents.view(), held.view(), planted.view(), stiffness, smoothness, standing, change.view());
      },
      Unlocked());
  m.def(
      "smooth_bones",
      [](Arg parents, Arg start, Arg lengths, Arg held, Arg planted, Arg feet, Arg toes, double stiffness,
         double foot_resistance, double steadiness, double standing, double bone_weight, double damping,
         double later_damping, double enough, std::int64_t steps, Arg joints) {
        smooth_bones(parents.view(), start.view(), lengths.view(), held.view(), planted.view(), feet.view(),
                     toes.view(),
                     {stiffness, foot_resistance, steadiness, standing, bone_weight, damping, later_damping}, enough,
                     steps, joints.view());
      },
      Unlocked());
  m.def(
      "frame_bones",
      [](Arg parents, Arg lengths, Arg held, Arg planted, Arg feet, double stiffness, double foot_resistance,
         double standing, double slack, double enough, double longest, std::int64_t steps, Arg joints) {
        frame_bones(parents.view(), lengths.view(), held.view(), planted.view(), feet.view(),
                    {stiffness, foot_resistance, 0, standing, 0, 0, 0}, slack, enough, longest, steps, joints.view());
      },
      Unlocked());
  m.def(
      "swing_rotations",
      [](Arg parents, Arg starts, Arg before, Arg after, Arg heading, Arg rotations) {
        swing_rotations(parents.view(), starts.view(), before.view(), after.view(), heading.view(), rotations.view());
      },
      Unlocked());
  m.def(
      "winograd_parts", [](Arg x, Arg rows, Arg parts) { winograd_parts(x.view(), rows.view(), parts.view()); },
      Unlocked());
  m.def(
      "winograd_frames",
      [](Arg products, Arg rows, Arg bias, bool is_rectified, Arg y) {
        winograd_frames(products.view(), rows.view(), bias.view(), is_rectified, y.view());
      },
      Unlocked());
}

}  // namespace
}  // namespace controlmm

CONTROLMM_MODULE(_core, m) { controlmm::register_kernels(m); }
