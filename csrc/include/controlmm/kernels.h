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
void recover_joints_backward(const TensorView& features, const TensorView& grad_joints, const TensorView& grad_features,
                             int threads = 1);

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

/// Signed-distance primitives. Each is a row of up to `kObstacleParameters` numbers, which may change frame by frame.
enum class ObstacleKind : std::int64_t {
  sphere = 0,        ///< center (3), radius
  capsule = 1,       ///< end a (3), end b (3), radius
  box = 2,           ///< center (3), half extents (3), rotation matrix from box to world, row-major (9)
  plane = 3,         ///< unit normal (3), offset: a thin wall; distance |normal . p - offset|
  half_space = 4,    ///< unit normal (3), offset: solid where normal . p < offset
  height_field = 5,  ///< x and z of the first sample, spacing in x and z: solid below the bilinear surface; the
                     ///< distance is vertical, and the border continues outwards
};

constexpr std::int64_t kObstacleParameters = 16;

/// Obstacles of one call.
struct Obstacles {
  TensorView kinds;       ///< int64 [obstacles, 4]: kind; for height fields also first sample, rows (x), columns (z)
  TensorView parameters;  ///< [batch or 1, obstacles, kObstacleParameters, frames or 1]
  TensorView heights;     ///< [samples] of all height fields, each row-major [rows, columns]
};

/// Which joints count against obstacles and how.
struct Clearance {
  TensorView radii;      ///< [joints]: each joint is a ball of this radius, in metres
  TensorView is_active;  ///< boolean [joints]
  TensorView lengths;    ///< int64 [batch]: frames that count, from the first
  double margin = 0;     ///< extra clearance in metres (the safe distance d of ControlMM, equation 9)
  bool is_mean = true;   ///< divide by active joints x counted frames x obstacles
};

/// Depth by which joints enter the obstacles: sum or mean of max(0, margin + radius - distance).
/// @param joints [batch, frames, joints, 3].
/// @param loss   [batch].
void obstacle_loss(const TensorView& joints, const Obstacles& obstacles, const Clearance& clearance,
                   const TensorView& loss, int threads = 1);

/// Gradient of `obstacle_loss` with respect to `joints`.
/// @param grad_loss   [batch].
/// @param grad_joints [batch, frames, joints, 3], any strides.
void obstacle_loss_backward(const TensorView& joints, const Obstacles& obstacles, const Clearance& clearance,
                            const TensorView& grad_loss, const TensorView& grad_joints, int threads = 1);

/// Value and gradient of control and obstacle losses on a decoder's own output, in one pass: de-normalisation,
/// kinematics and losses, without a tensor of joints. Fastest where frames are contiguous in every argument.
/// @param decoded   [batch, dim, frames], normalised.
/// @param mean, std Row-major [dim]: features = decoded * std + mean.
/// @param targets   [batch, frames, joints, 3] in metres; @param mask boolean of the same shape.
/// @param obstacle_weight Factor of the obstacle loss; the control loss has factor 1 and is averaged for each clip.
/// @param loss      [batch].
/// @param gradient  [batch, dim, frames], any strides. Only channels below 4 + 3 (joints - 1) are written: hand in
///                  zeros once and the same memory again in later calls.
void guidance_value_and_grad(const TensorView& decoded, const TensorView& mean, const TensorView& std,
                             const TensorView& targets, const TensorView& mask, Norm norm, const Obstacles& obstacles,
                             const Clearance& clearance, double obstacle_weight, const TensorView& loss,
                             const TensorView& gradient, int threads = 1);

/// Same without obstacles.
void guidance_value_and_grad(const TensorView& decoded, const TensorView& mean, const TensorView& std,
                             const TensorView& targets, const TensorView& mask, Norm norm, const TensorView& loss,
                             const TensorView& gradient, int threads = 1);

/// Place of a draw in the noise: a function of these and the position only, so that threads and batch splits agree.
struct NoiseSource {
  std::uint64_t seed = 0;
  std::int64_t first_clip = 0;  ///< number of the first clip of this call in the whole batch
};

/// Standard Gumbel noise -log(-log(u)), u from Philox 4x32-10 (Salmon et al. 2011).
/// Element (b, l, k) takes word (k mod 64) / 16 of the block with counter
/// (16 floor(k / 64) + k mod 16, l, first_clip + b, 0) and key = seed; u = (floor(word / 512) + 1/2) / 2^23.
/// @param noise Row-major [batch, tokens, codes].
void gumbel_noise(NoiseSource source, const TensorView& noise, int threads = 1);

/// Draws one code for each token, argmax(logits + noise), and copies its row of the codebook.
/// @param logits        [batch, tokens, codes], codes contiguous.
/// @param codebook      Row-major [codes, channels].
/// @param temperature   Of the soft probabilities, above 0; the drawn codes do not depend on it.
/// @param ids           Row-major int64 [batch, tokens].
/// @param embeddings    Row-major [batch, tokens, channels]; no channels skips the copy.
/// @param probabilities Row-major [batch, tokens, codes], softmax((logits + noise) / temperature); or no codes, if
///                      they are not wanted.
void gumbel_straight_through(const TensorView& logits, const TensorView& codebook, double temperature,
                             NoiseSource source, const TensorView& ids, const TensorView& embeddings,
                             const TensorView& probabilities, int threads = 1);

/// Gradient of the soft probabilities with respect to the logits.
/// @param probabilities Row-major [rows, codes].
/// @param gradient      Row-major [rows, codes]: on entry the gradient of the probabilities, on return of the logits.
void softmax_backward(const TensorView& probabilities, double temperature, const TensorView& gradient, int threads = 1);

/// The kernels of the closed end work on one clip in double precision, in one thread. `parents`: int64 [joints], -1
/// for the root, which comes first, and parents before their children.

/// What joints resist with and bones pull with; see the Python functions of the same names.
struct PoseWeights {
  double stiffness, foot_resistance, steadiness, standing, bone_weight, damping, later_damping;
};

/// The smallest smooth change of a clip that moves the held coordinates by what they lack; see `project_change`.
/// @param held    Boolean [frames, joints, 3]; @param planted boolean [frames, joints].
/// @param change  Row-major [frames, joints, 3]: in, the change wanted where held; out, the change everywhere.
void project_change(const TensorView& parents, const TensorView& held, const TensorView& planted, double stiffness,
                    double smoothness, double standing, const TensorView& change);

/// Bones of the right length, all frames of a clip together. Takes the longer, the more `steadiness` and `standing`
/// exceed `damping` and `later_damping`: eleven times at a thousandfold.
/// @param start   Row-major [frames, joints, 3]; @param lengths [joints]; @param feet, toes boolean [joints].
/// @param enough  Largest error of a bone at which to stop; @param steps at most so many.
/// @param joints  Row-major [frames, joints, 3]: in, where to begin; out, moved.
void smooth_bones(const TensorView& parents, const TensorView& start, const TensorView& lengths, const TensorView& held,
                  const TensorView& planted, const TensorView& feet, const TensorView& toes, const PoseWeights& weights,
                  double enough, std::int64_t steps, const TensorView& joints);

/// Bones of the right length, each frame for itself.
/// @param slack   So that a pose out of reach gives the nearest one instead of none.
/// @param longest Of a coordinate's way in one step.
void frame_bones(const TensorView& parents, const TensorView& lengths, const TensorView& held,
                 const TensorView& planted, const TensorView& feet, const PoseWeights& weights, double slack,
                 double enough, double longest, std::int64_t steps, const TensorView& joints);

/// Local rotations whose bones swing from `before` to `after`, each frame for itself; see `swing_rotations`.
/// @param starts    Boolean [joints]: whose rotation is relative to the heading instead of the parent's.
/// @param before, after Row-major [frames, joints, 3].
/// @param heading   Row-major [frames, 4], quaternions (w, x, y, z) of any length.
/// @param rotations Row-major [frames, joints - 1, 6]: in, those of the bones before; out, after.
void swing_rotations(const TensorView& parents, const TensorView& starts, const TensorView& before,
                     const TensorView& after, const TensorView& heading, const TensorView& rotations);

/// A convolution over time of width 3 by Winograd's F(4, 3), but for its products: what they take, see
/// `winograd_parts`.
/// @param x     Row-major [frames, channels].
/// @param rows  Row-major int64 [tiles, 6]: the frames of a tile, -1 for zeros.
/// @param parts Row-major [6, tiles, channels].
void winograd_parts(const TensorView& x, const TensorView& rows, const TensorView& parts);

/// What the products make, see `winograd_frames`.
/// @param products Row-major [6, tiles, channels].
/// @param rows     Row-major int64 [tiles, 4]: the frames that a tile makes, -1 for none; each frame is made once.
/// @param bias     [channels], or none for no bias.
/// @param y        Row-major [frames, channels].
void winograd_frames(const TensorView& products, const TensorView& rows, const TensorView& bias, bool is_rectified,
                     const TensorView& y);

}  // namespace controlmm
