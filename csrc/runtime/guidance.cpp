#include <utility>
#include <vector>

#include "clip_work.h"
#include "obstacle_arguments.h"

namespace controlmm {
namespace {

constexpr double kNsPerJointFrame = 3;  // measured on one core, all joints controlled

void check_guidance_shapes(const TensorView& decoded, const TensorView& mean, const TensorView& std,
                           const TensorView& targets, const TensorView& mask, const TensorView& loss,
                           const TensorView& gradient) {
  const DType dtype = decoded.dtype;
  const std::int64_t clips = decoded.shape[0], dim = decoded.shape[1], frames = decoded.shape[2];
  for (const auto& [view, name] : {std::pair{&mean, "mean"}, std::pair{&std, "std"}}) {
    checks::require(*view, name, 1, dtype);
    checks::require_shape(*view, name, {dim});
    checks::require_contiguous(*view, name);
  }
  checks::require(targets, "targets", 4, dtype);
  const std::int64_t joints = targets.shape[2];
  checks::require_shape(targets, "targets", {clips, frames, joints, 3});
  checks::require(mask, "mask", 4, DType::boolean);
  checks::require_shape(mask, "mask", {clips, frames, joints, 3});
  if (joints < 1 || dim < 4 + 3 * (joints - 1))
    throw std::invalid_argument("`decoded` must have at least 4 + 3 (J - 1) channels for the " +
                                std::to_string(joints) + " joints of `targets`, got shape " +
                                checks::shape_text(decoded) + ".");
  checks::require(loss, "loss", 1, dtype);
  checks::require_shape(loss, "loss", {clips});
  checks::require_row_major(loss, "loss");
  checks::require(gradient, "gradient", 3, dtype);
  checks::require_shape(gradient, "gradient", {clips, dim, frames});
  checks::require_distinct_elements(gradient, "gradient");
}

template <class T>
GuidanceArgs<T> guidance_args(const TensorView& decoded, const TensorView& mean, const TensorView& std,
                              const TensorView& targets, const TensorView& mask, Norm norm, const TensorView& loss,
                              const TensorView& gradient) {
  checks::require(decoded, "decoded", 3, decoded.dtype);
  check_guidance_shapes(decoded, mean, std, targets, mask, loss, gradient);
  GuidanceArgs<T> args{};
  args.shape = {decoded.shape[2], targets.shape[2], decoded.shape[1]};
  args.decoded = {decoded.as<const T>(), decoded.strides[0], decoded.strides[2], decoded.strides[1]};
  args.mean = mean.as<const T>();
  args.std = std.as<const T>();
  args.targets = checks::strided4<const T>(targets);
  args.mask = checks::strided4<const std::uint8_t>(mask);
  args.norm = norm;
  args.loss = loss.as<T>();
  args.gradient = {gradient.as<T>(), gradient.strides[0], gradient.strides[2], gradient.strides[1]};
  args.frames_are_neighbours =
      args.decoded.frame == 1 && args.targets.frame == 1 && args.mask.frame == 1 && args.gradient.frame == 1;
  return args;
}

template <class T>
void run_guidance(const GuidanceArgs<T>& args, std::int64_t clips, double collision_ns, int threads) {
  const MotionShape& shape = args.shape;
  for (std::int64_t clip = 0; clip < clips; ++clip) args.loss[clip] = 0;
  if (shape.frames == 0) return;
  const double work_ns = kNsPerJointFrame * static_cast<double>(clips * shape.frames * shape.joints) + collision_ns;
  const auto kernel = active_kernels().of<T>().guidance;
  run_over_clips(clips, work_ns, threads, guidance_scratch(shape, args.obstacles.count),
                 [&](ClipRange range, double* scratch) { kernel(args, range, scratch); });
}

}  // namespace

void guidance_value_and_grad(const TensorView& decoded, const TensorView& mean, const TensorView& std,
                             const TensorView& targets, const TensorView& mask, Norm norm, const Obstacles& obstacles,
                             const Clearance& clearance, double obstacle_weight, const TensorView& loss,
                             const TensorView& gradient, int threads) {
  checks::for_dtype(decoded, "decoded", [&](auto zero) {
    using T = decltype(zero);
    GuidanceArgs<T> args = guidance_args<T>(decoded, mean, std, targets, mask, norm, loss, gradient);
    const std::int64_t clips = decoded.shape[0];
    args.obstacles = checked_obstacles<T>(obstacles, clearance, clips, args.shape);
    std::vector<double> scales(static_cast<std::size_t>(clips));
    for (std::int64_t clip = 0; clip < clips; ++clip)
      scales[static_cast<std::size_t>(clip)] =
          obstacle_weight * depth_scale(args.obstacles, args.shape, clip, clearance.is_mean);
    args.obstacle_scales = scales.data();
    run_guidance(args, clips, collision_ns(args.obstacles, args.shape, clips), threads);
  });
}

void guidance_value_and_grad(const TensorView& decoded, const TensorView& mean, const TensorView& std,
                             const TensorView& targets, const TensorView& mask, Norm norm, const TensorView& loss,
                             const TensorView& gradient, int threads) {
  checks::for_dtype(decoded, "decoded", [&](auto zero) {
    using T = decltype(zero);
    run_guidance(guidance_args<T>(decoded, mean, std, targets, mask, norm, loss, gradient), decoded.shape[0], 0.0,
                 threads);
  });
}

}  // namespace controlmm
