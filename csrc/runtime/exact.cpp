#include <memory>

#include "checks.h"

namespace controlmm {
namespace {

using Flags = const std::uint8_t*;

BodyTree body_tree(const TensorView& parents, const TensorView& joints, const char* name) {
  checks::require(joints, name, 3, DType::float64);
  checks::require(parents, "parents", 1, DType::int64);
  checks::require_contiguous(parents, "parents");
  const BodyTree body{joints.shape[0], joints.shape[1], parents.as<const std::int64_t>()};
  checks::require_shape(parents, "parents", {body.joints});
  checks::require_shape(joints, name, {body.frames, body.joints, 3});
  for (std::int64_t j = 0; j < body.joints; ++j) {
    const bool fits = j == 0 ? body.parents[j] == -1 : body.parents[j] >= 0 && body.parents[j] < j;
    if (!fits)
      throw std::invalid_argument(
          "`parents` must name an earlier joint for every joint but the first, which has -1, "
          "got " +
          std::to_string(body.parents[j]) + " for joint " + std::to_string(j) + ".");
  }
  return body;
}

// Of joints that a kernel moves.
BodyTree moved_body(const TensorView& parents, const TensorView& joints, const char* name) {
  const BodyTree body = body_tree(parents, joints, name);
  checks::require_row_major(joints, name);
  return body;
}

Flags flags(const TensorView& view, const char* name, std::initializer_list<std::int64_t> shape) {
  checks::require(view, name, static_cast<int>(shape.size()), DType::boolean);
  checks::require_shape(view, name, shape);
  checks::require_contiguous(view, name);
  return view.as<const std::uint8_t>();
}

const double* numbers(const TensorView& view, const char* name, std::initializer_list<std::int64_t> shape) {
  checks::require(view, name, static_cast<int>(shape.size()), DType::float64);
  checks::require_shape(view, name, shape);
  checks::require_contiguous(view, name);
  return view.as<const double>();
}

std::unique_ptr<double[]> scratch(std::int64_t doubles) {
  return std::unique_ptr<double[]>(new double[static_cast<std::size_t>(doubles)]);
}

}  // namespace

void project_change(const TensorView& parents, const TensorView& held, const TensorView& planted, double stiffness,
                    double smoothness, double standing, const TensorView& change) {
  const BodyTree body = moved_body(parents, change, "change");
  const ProjectionArgs args{body,
                            flags(held, "held", {body.frames, body.joints, 3}),
                            flags(planted, "planted", {body.frames, body.joints}),
                            stiffness,
                            smoothness,
                            standing,
                            change.as<double>()};
  if (change.size() == 0) return;
  const auto memory = scratch(banded_system_scratch(body.frames * body.joints, 2 * body.joints));
  active_kernels().exact.project(args, memory.get());
}

void smooth_bones(const TensorView& parents, const TensorView& start, const TensorView& lengths, const TensorView& held,
                  const TensorView& planted, const TensorView& feet, const TensorView& toes, const PoseWeights& weights,
                  double enough, std::int64_t steps, const TensorView& joints) {
  const BodyTree body = moved_body(parents, joints, "joints");
  const SmoothBonesArgs args{body,
                             numbers(start, "start", {body.frames, body.joints, 3}),
                             numbers(lengths, "lengths", {body.joints}),
                             flags(held, "held", {body.frames, body.joints, 3}),
                             flags(planted, "planted", {body.frames, body.joints}),
                             flags(feet, "feet", {body.joints}),
                             flags(toes, "toes", {body.joints}),
                             weights.stiffness,
                             weights.foot_resistance,
                             weights.steadiness,
                             weights.standing,
                             weights.bone_weight,
                             weights.damping,
                             weights.later_damping,
                             enough,
                             steps,
                             joints.as<double>()};
  if (joints.size() == 0) return;
  const auto memory = scratch(clip_system_scratch(body.frames, body.joints));
  active_kernels().exact.smooth_bones(args, memory.get());
}

void frame_bones(const TensorView& parents, const TensorView& lengths, const TensorView& held,
                 const TensorView& planted, const TensorView& feet, const PoseWeights& weights, double slack,
                 double enough, double longest, std::int64_t steps, const TensorView& joints) {
  const BodyTree body = moved_body(parents, joints, "joints");
  const FrameBonesArgs args{body,
                            numbers(lengths, "lengths", {body.joints}),
                            flags(held, "held", {body.frames, body.joints, 3}),
                            flags(planted, "planted", {body.frames, body.joints}),
                            flags(feet, "feet", {body.joints}),
                            weights.stiffness,
                            weights.foot_resistance,
                            weights.standing,
                            slack,
                            enough,
                            longest,
                            steps,
                            joints.as<double>()};
  if (joints.size() == 0 || body.joints < 2) return;
  const auto memory = scratch(frame_bones_scratch(body.joints));
  active_kernels().exact.frame_bones(args, memory.get());
}

void swing_rotations(const TensorView& parents, const TensorView& starts, const TensorView& before,
                     const TensorView& after, const TensorView& heading, const TensorView& rotations) {
  const BodyTree body = body_tree(parents, before, "before");
  checks::require(rotations, "rotations", 3, DType::float64);
  checks::require_shape(rotations, "rotations", {body.frames, body.joints - 1, 6});
  checks::require_row_major(rotations, "rotations");
  const SwingArgs args{body,
                       flags(starts, "starts", {body.joints}),
                       numbers(before, "before", {body.frames, body.joints, 3}),
                       numbers(after, "after", {body.frames, body.joints, 3}),
                       numbers(heading, "heading", {body.frames, 4}),
                       rotations.as<double>()};
  if (rotations.size() == 0) return;
  const auto memory = scratch(swing_scratch(body.joints));
  active_kernels().exact.swing_rotations(args, memory.get());
}

}  // namespace controlmm
