#include "checks.h"
#include "clip_work.h"

namespace controlmm {
namespace {

// Measured on one core: what a frame of 22 joints costs.
constexpr double kForwardNsPerFrame = 30, kBackwardNsPerFrame = 60;

MotionShape motion_shape(const TensorView& features, std::int64_t joints) {
  const MotionShape shape{features.shape[1], joints, features.shape[2]};
  if (joints < 1) throw std::invalid_argument("`joints` must be at least 1, got " + std::to_string(joints) + ".");
  const std::int64_t needed = 4 + 3 * (joints - 1);
  if (shape.dim < needed)
    throw std::invalid_argument("`features` must have at least " + std::to_string(needed) + " channels for " +
                                std::to_string(joints) + " joints, got shape " + checks::shape_text(features) + ".");
  return shape;
}

double total_ns(const MotionShape& shape, std::int64_t clips, double ns_per_frame) {
  return ns_per_frame * static_cast<double>(clips * shape.frames);
}

}  // namespace

void recover_joints(const TensorView& features, const TensorView& joints, int threads) {
  checks::for_dtype(features, "features", [&](auto zero) {
    using T = decltype(zero);
    checks::require(features, "features", 3, features.dtype);
    checks::require(joints, "joints", 4, features.dtype);
    const MotionShape shape = motion_shape(features, joints.shape[2]);
    checks::require_shape(joints, "joints", {features.shape[0], shape.frames, shape.joints, 3});
    checks::require_row_major(joints, "joints");
    if (joints.size() == 0) return;
    const RecoverArgs<T> args{shape, checks::strided3<const T>(features), joints.as<T>()};
    const auto kernel = active_kernels().of<T>().recover_joints;
    run_over_clips(features.shape[0], total_ns(shape, features.shape[0], kForwardNsPerFrame), threads,
                   kinematics_scratch(shape), [&](ClipRange range, double* scratch) { kernel(args, range, scratch); });
  });
}

void recover_joints_backward(const TensorView& features, const TensorView& grad_joints, const TensorView& grad_features,
                             int threads) {
  checks::for_dtype(features, "features", [&](auto zero) {
    using T = decltype(zero);
    checks::require(features, "features", 3, features.dtype);
    checks::require(grad_joints, "grad_joints", 4, features.dtype);
    checks::require(grad_features, "grad_features", 3, features.dtype);
    const MotionShape shape = motion_shape(features, grad_joints.shape[2]);
    checks::require_shape(grad_joints, "grad_joints", {features.shape[0], shape.frames, shape.joints, 3});
    checks::require_shape(grad_features, "grad_features", {features.shape[0], shape.frames, shape.dim});
    checks::require_distinct_elements(grad_features, "grad_features");
    if (grad_features.size() == 0) return;
    const RecoverBackwardArgs<T> args{shape, checks::strided3<const T>(features),
                                      checks::strided4<const T>(grad_joints), checks::strided3<T>(grad_features)};
    const auto kernel = active_kernels().of<T>().recover_joints_backward;
    run_over_clips(features.shape[0], total_ns(shape, features.shape[0], kBackwardNsPerFrame), threads,
                   kinematics_scratch(shape), [&](ClipRange range, double* scratch) { kernel(args, range, scratch); });
  });
}

}  // namespace controlmm
