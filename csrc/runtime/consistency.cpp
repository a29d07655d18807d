#include <vector>

#include "checks.h"
#include "clip_work.h"

namespace controlmm {
namespace {

constexpr double kNsPerJoint = 2;  // measured on one core, dense control

template <class T>
ConsistencyArgs<T> checked_args(const TensorView& joints, const TensorView& targets, const TensorView& mask,
                                Norm norm) {
  checks::require(joints, "joints", 4, joints.dtype);
  checks::require(targets, "targets", 4, joints.dtype);
  checks::require(mask, "mask", 4, DType::boolean);
  const std::int64_t* s = joints.shape;
  checks::require_shape(joints, "joints", {s[0], s[1], s[2], 3});
  checks::require_shape(targets, "targets", {s[0], s[1], s[2], 3});
  checks::require_shape(mask, "mask", {s[0], s[1], s[2], 3});
  ConsistencyArgs<T> args{};
  args.shape = {s[1], s[2], 0};
  args.joints = checks::strided4<const T>(joints);
  args.targets = checks::strided4<const T>(targets);
  args.mask = checks::strided4<const std::uint8_t>(mask);
  args.norm = norm;
  return args;
}

// One value a clip, or a single one for all.
bool check_per_clip(const TensorView& view, const char* name, std::int64_t clips, DType dtype) {
  checks::require(view, name, view.ndim == 0 ? 0 : 1, dtype);
  if (view.ndim == 1) checks::require_shape(view, name, {clips});
  return view.ndim == 1;
}

double total_ns(const TensorView& joints) { return kNsPerJoint * static_cast<double>(joints.size()) / 3; }

double mean_of(double sum, double count) { return count == 0 ? 0 : sum / count; }

}  // namespace

void masked_consistency_loss(const TensorView& joints, const TensorView& targets, const TensorView& mask, Norm norm,
                             const TensorView& loss, const TensorView& counts, int threads) {
  checks::for_dtype(joints, "joints", [&](auto zero) {
    using T = decltype(zero);
    ConsistencyArgs<T> args = checked_args<T>(joints, targets, mask, norm);
    const std::int64_t clips = joints.shape[0];
    const bool is_per_clip = check_per_clip(loss, "loss", clips, joints.dtype);
    if (check_per_clip(counts, "counts", clips, DType::float64) != is_per_clip)
      throw std::invalid_argument("`counts` must have the shape of `loss`, got " + checks::shape_text(counts) + ".");
    checks::require_row_major(loss, "loss");
    checks::require_row_major(counts, "counts");
    std::vector<double> totals(2 * static_cast<std::size_t>(clips));
    args.sums = totals.data();
    args.counts = totals.data() + clips;
    const auto kernel = active_kernels().of<T>().consistency;
    if (joints.size() != 0)
      run_over_clips(clips, total_ns(joints), threads, 0, [&](ClipRange range, double*) { kernel(args, range); });

    double sum = 0, count = 0;
    for (std::int64_t clip = 0; clip < clips; ++clip) {
      sum += args.sums[clip];
      count += args.counts[clip];
      if (!is_per_clip) continue;
      loss.as<T>()[clip] = static_cast<T>(mean_of(args.sums[clip], args.counts[clip]));
      counts.as<double>()[clip] = args.counts[clip];
    }
    if (is_per_clip) return;
    *loss.as<T>() = static_cast<T>(mean_of(sum, count));
    *counts.as<double>() = count;
  });
}

void masked_consistency_loss_backward(const TensorView& joints, const TensorView& targets, const TensorView& mask,
                                      Norm norm, const TensorView& grad_loss, const TensorView& counts,
                                      const TensorView& grad_joints, int threads) {
  checks::for_dtype(joints, "joints", [&](auto zero) {
    using T = decltype(zero);
    ConsistencyArgs<T> args = checked_args<T>(joints, targets, mask, norm);
    const std::int64_t clips = joints.shape[0];
    const bool is_per_clip = check_per_clip(grad_loss, "grad_loss", clips, joints.dtype);
    if (check_per_clip(counts, "counts", clips, DType::float64) != is_per_clip)
      throw std::invalid_argument("`counts` must have the shape of `grad_loss`, got " + checks::shape_text(counts) +
                                  ".");
    checks::require(grad_joints, "grad_joints", 4, joints.dtype);
    checks::require_shape(grad_joints, "grad_joints", {clips, joints.shape[1], joints.shape[2], 3});
    checks::require_row_major(grad_joints, "grad_joints");
    if (joints.size() == 0) return;

    std::vector<T> scales(static_cast<std::size_t>(clips));
    for (std::int64_t clip = 0; clip < clips; ++clip) {
      const double count = counts.as<double>()[is_per_clip ? clip * counts.strides[0] : 0];
      const T grad = grad_loss.as<T>()[is_per_clip ? clip * grad_loss.strides[0] : 0];
      scales[static_cast<std::size_t>(clip)] = static_cast<T>(mean_of(static_cast<double>(grad), count));
    }
    args.scales = scales.data();
    args.grad_joints = grad_joints.as<T>();
    const auto kernel = active_kernels().of<T>().consistency_backward;
    run_over_clips(clips, total_ns(joints), threads, 0, [&](ClipRange range, double*) { kernel(args, range); });
  });
}

}  // namespace controlmm
