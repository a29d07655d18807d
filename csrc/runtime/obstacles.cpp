#include <vector>

#include "clip_work.h"
#include "obstacle_arguments.h"

namespace controlmm {
namespace {

template <class T>
ObstacleLossArgs<T> checked_args(const TensorView& joints, const Obstacles& obstacles, const Clearance& clearance) {
  checks::require(joints, "joints", 4, joints.dtype);
  checks::require_shape(joints, "joints", {joints.shape[0], joints.shape[1], joints.shape[2], 3});
  ObstacleLossArgs<T> args{};
  args.shape = {joints.shape[1], joints.shape[2], 0};
  args.joints = checks::strided4<const T>(joints);
  args.obstacles = checked_obstacles<T>(obstacles, clearance, joints.shape[0], args.shape);
  return args;
}

template <class T>
void fill_zero(const TensorView& view) {
  const std::int64_t *n = view.shape, *s = view.strides;
  for (std::int64_t b = 0; b < n[0]; ++b)
    for (std::int64_t t = 0; t < n[1]; ++t)
      for (std::int64_t j = 0; j < n[2]; ++j)
        for (std::int64_t c = 0; c < n[3]; ++c) view.as<T>()[b * s[0] + t * s[1] + j * s[2] + c * s[3]] = 0;
}

}  // namespace

void obstacle_loss(const TensorView& joints, const Obstacles& obstacles, const Clearance& clearance,
                   const TensorView& loss, int threads) {
  checks::for_dtype(joints, "joints", [&](auto zero) {
    using T = decltype(zero);
    ObstacleLossArgs<T> args = checked_args<T>(joints, obstacles, clearance);
    const std::int64_t clips = joints.shape[0];
    checks::require(loss, "loss", 1, joints.dtype);
    checks::require_shape(loss, "loss", {clips});
    checks::require_row_major(loss, "loss");
    std::vector<double> sums(static_cast<std::size_t>(clips));
    args.sums = sums.data();
    const auto kernel = active_kernels().of<T>().obstacle_loss;
    if (args.obstacles.count != 0)
      run_over_clips(clips, collision_ns(args.obstacles, args.shape, clips), threads,
                     obstacle_scratch(args.obstacles.count),
                     [&](ClipRange range, double* scratch) { kernel(args, range, scratch); });
    for (std::int64_t clip = 0; clip < clips; ++clip)
      loss.as<T>()[clip] = static_cast<T>(sums[static_cast<std::size_t>(clip)] *
                                          depth_scale(args.obstacles, args.shape, clip, clearance.is_mean));
  });
}

void obstacle_loss_backward(const TensorView& joints, const Obstacles& obstacles, const Clearance& clearance,
                            const TensorView& grad_loss, const TensorView& grad_joints, int threads) {
  checks::for_dtype(joints, "joints", [&](auto zero) {
    using T = decltype(zero);
    ObstacleLossArgs<T> args = checked_args<T>(joints, obstacles, clearance);
    const std::int64_t clips = joints.shape[0];
    checks::require(grad_loss, "grad_loss", 1, joints.dtype);
    checks::require_shape(grad_loss, "grad_loss", {clips});
    checks::require(grad_joints, "grad_joints", 4, joints.dtype);
    checks::require_shape(grad_joints, "grad_joints", {clips, joints.shape[1], joints.shape[2], 3});
    checks::require_distinct_elements(grad_joints, "grad_joints");
    fill_zero<T>(grad_joints);
    if (args.obstacles.count == 0) return;

    std::vector<T> scales(static_cast<std::size_t>(clips));
    for (std::int64_t clip = 0; clip < clips; ++clip)
      scales[static_cast<std::size_t>(clip)] =
          static_cast<T>(static_cast<double>(grad_loss.as<T>()[clip * grad_loss.strides[0]]) *
                         depth_scale(args.obstacles, args.shape, clip, clearance.is_mean));
    args.scales = scales.data();
    args.grad_joints = checks::strided4<T>(grad_joints);
    const auto kernel = active_kernels().of<T>().obstacle_loss_backward;
    run_over_clips(clips, collision_ns(args.obstacles, args.shape, clips), threads,
                   obstacle_scratch(args.obstacles.count),
                   [&](ClipRange range, double* scratch) { kernel(args, range, scratch); });
  });
}

}  // namespace controlmm
