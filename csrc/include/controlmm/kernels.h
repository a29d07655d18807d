#pragma once

#include "controlmm/tensor_view.h"

/// Operators on motion: positions in metres, Y up. Inputs are float32 or float64 (all floating arguments of one
/// call alike) and may have any strides; outputs are written completely unless stated otherwise.
///
/// Every function is thread-safe (calls share no state), borrows its arguments only during the call, throws
/// std::invalid_argument when an argument does not fit, and computes the same bits for any `threads`, any position
/// of a clip in its batch and any instruction set.
namespace controlmm {

/// How the distance between a joint and its target is counted.
enum class Norm : int {
  l2 = 0,   ///< Euclidean distance of the masked coordinates, averaged over joints with any of them masked
  l1 = 1,   ///< absolute difference, averaged over masked coordinates
  mse = 2,  ///< squared difference, averaged over masked coordinates
};

/// Global joint positions of de-normalised HumanML3D / KIT features.
/// @param features [batch, frames, dim], dim >= 4 + 3 (joints - 1); channels past that are not read.
/// @param joints   Row-major [batch, frames, joints, 3].
/// @param threads  Upper bound; small work stays in the calling thread.
void recover_joints(const TensorView& features, const TensorView& joints, int threads = 1);

/// Gradient of `recover_joints` with respect to its input.
/// @param grad_joints   [batch, frames, joints, 3].
/// @param grad_features [batch, frames, dim], any strides; unused channels become zero.
void recover_joints_backward(const TensorView& features, const TensorView& grad_joints,
                             const TensorView& grad_features, int threads = 1);

/// Distance of controlled joints to their targets. An empty mask gives exactly 0.
/// @param joints, targets [batch, frames, joints, 3]; values outside the mask are never used, NaN included.
/// @param mask  Boolean [batch, frames, joints, 3].
/// @param loss  [batch] for one value a clip, or no dimension for one value pooled over all entries.
/// @param counts Float64, as many elements as `loss`: the divisors, needed by the gradient.
void masked_consistency_loss(const TensorView& joints, const TensorView& targets, const TensorView& mask, Norm norm,
                             const TensorView& loss, const TensorView& counts, int threads = 1);

/// Gradient of `masked_consistency_loss` with respect to `joints` (that of `targets` is its negative).
/// @param grad_loss   Shaped like `loss`.
/// @param counts      As written by the forward call.
/// @param grad_joints Row-major [batch, frames, joints, 3].
void masked_consistency_loss_backward(const TensorView& joints, const TensorView& targets, const TensorView& mask,
                                      Norm norm, const TensorView& grad_loss, const TensorView& counts,
                                      const TensorView& grad_joints, int threads = 1);

}  // namespace controlmm
