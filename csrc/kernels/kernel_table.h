#pragma once

#include <cstdint>

#include "controlmm/kernels.h"

namespace controlmm {

/// Address of an array and the distance, in elements, between neighbours along its axes.
template <class T>
struct Strided3 {
  T* data;
  std::int64_t clip, frame, channel;
};

template <class T>
struct Strided4 {
  T* data;
  std::int64_t clip, frame, joint, coord;
};

struct MotionShape {
  std::int64_t frames, joints, dim;
};

template <class T>
struct RecoverArgs {
  MotionShape shape;
  Strided3<const T> features;
  T* joints;  // row-major
};

template <class T>
struct RecoverBackwardArgs {
  MotionShape shape;
  Strided3<const T> features;
  Strided4<const T> grad_joints;
  Strided3<T> grad_features;
};

template <class T>
struct ConsistencyArgs {
  MotionShape shape;
  Strided4<const T> joints, targets;
  Strided4<const std::uint8_t> mask;
  Norm norm;
  double* sums;     // one a clip
  double* counts;   // one a clip
  const T* scales;  // one a clip; backward only
  T* grad_joints;   // row-major; backward only
};

/// Obstacles and what counts against them, ready for the kernels: extents of 1 have become strides of 0.
template <class T>
struct ObstacleArgs {
  std::int64_t count;
  const std::int64_t* kinds;     // row-major [count, 4]
  Strided4<const T> parameters;  // clip, frame, obstacle (as joint), parameter (as coord)
  const T* heights;
  const T* radii;                 // one a joint
  const std::uint8_t* is_active;  // one a joint
  const std::int64_t* lengths;    // one a clip
  T margin;
};

template <class T>
struct ObstacleLossArgs {
  MotionShape shape;
  Strided4<const T> joints;
  ObstacleArgs<T> obstacles;
  double* sums;             // one a clip
  const T* scales;          // one a clip; backward only
  Strided4<T> grad_joints;  // backward only
};

template <class T>
struct GuidanceArgs {
  MotionShape shape;
  Strided3<const T> decoded;
  const T *mean, *std;
  Strided4<const T> targets;
  Strided4<const std::uint8_t> mask;
  Norm norm;
  ObstacleArgs<T> obstacles;
  bool frames_are_neighbours;     // in `decoded`, `targets`, `mask` and `gradient`
  const double* obstacle_scales;  // one a clip
  T* loss;
  Strided3<T> gradient;
};

template <class T>
struct GumbelArgs {
  std::int64_t tokens, codes, channels;
  const T* logits;  // null draws bare noise into `probabilities`
  std::int64_t clip_stride, token_stride;
  const T* codebook;
  T temperature;
  NoiseSource source;
  std::int64_t* ids;
  T* embeddings;
  T* probabilities;  // may be null
};

template <class T>
struct SoftmaxArgs {
  std::int64_t codes;
  const T* probabilities;
  T inverse_temperature;
  T* gradient;
};

template <class T>
struct WinogradPartsArgs {
  std::int64_t tiles, channels;
  const std::int64_t* rows;  // [tiles, 6], -1 for zeros
  const T *x, *zeros;        // row-major [frames, channels]; a row
  T* parts;                  // row-major [6, tiles, channels]
};

template <class T>
struct WinogradFramesArgs {
  std::int64_t tiles, channels;
  const std::int64_t* rows;  // [tiles, 4], -1 for what nobody wants
  const T* products;         // row-major [6, tiles, channels]
  const T* bias;
  bool is_rectified;
  T *y, *discarded;  // row-major [frames, channels]; a row
};

/// Joints of a clip and the tree of their bones; a parent comes before its children, the root has -1.
struct BodyTree {
  std::int64_t frames, joints;
  const std::int64_t* parents;
};

// Of the closed end: one clip in double precision, row-major [frames, joints, 3] or [frames, joints].
struct ProjectionArgs {
  BodyTree body;
  const std::uint8_t *held, *planted;
  double stiffness, smoothness, standing;
  double* change;  // wanted where held; written everywhere
};

struct SmoothBonesArgs {
  BodyTree body;
  const double *start, *lengths;
  const std::uint8_t *held, *planted, *feet, *toes;
  double stiffness, foot_resistance, steadiness, standing, bone_weight, damping, later_damping, enough;
  std::int64_t steps;
  double* joints;  // the start's, then moved
};

struct FrameBonesArgs {
  BodyTree body;
  const double* lengths;
  const std::uint8_t *held, *planted, *feet;
  double stiffness, foot_resistance, standing, slack, enough, longest;
  std::int64_t steps;
  double* joints;  // moved in place
};

struct SwingArgs {
  BodyTree body;
  const std::uint8_t* starts;
  const double *before, *after, *heading;
  double* rotations;  // row-major [frames, joints - 1, 6], turned in place
};

/// Half-open range of clips; a clip is never split between threads, so sums keep their order.
struct ClipRange {
  std::int64_t begin, end;
};

template <class T>
struct Kernels {
  void (*recover_joints)(const RecoverArgs<T>&, ClipRange, double* scratch);
  void (*recover_joints_backward)(const RecoverBackwardArgs<T>&, ClipRange, double* scratch);
  void (*consistency)(const ConsistencyArgs<T>&, ClipRange);
  void (*consistency_backward)(const ConsistencyArgs<T>&, ClipRange);
  void (*obstacle_loss)(const ObstacleLossArgs<T>&, ClipRange, double* scratch);
  void (*obstacle_loss_backward)(const ObstacleLossArgs<T>&, ClipRange, double* scratch);
  void (*gumbel)(const GumbelArgs<T>&, ClipRange rows);
  void (*softmax_backward)(const SoftmaxArgs<T>&, ClipRange rows);
  void (*guidance)(const GuidanceArgs<T>&, ClipRange, double* scratch);
  void (*winograd_parts)(const WinogradPartsArgs<T>&);
  void (*winograd_frames)(const WinogradFramesArgs<T>&);
};

struct ExactKernels {
  void (*project)(const ProjectionArgs&, double* scratch);
  void (*smooth_bones)(const SmoothBonesArgs&, double* scratch);
  void (*frame_bones)(const FrameBonesArgs&, double* scratch);
  void (*swing_rotations)(const SwingArgs&, double* scratch);
};

struct KernelTable {
  const char* name;
  Kernels<float> f32;
  Kernels<double> f64;
  ExactKernels exact;

  template <class T>
  const Kernels<T>& of() const {
    if constexpr (sizeof(T) == 4) {
      return f32;
    } else {
      return f64;
    }
  }
};

constexpr std::int64_t kLanes = 16;

// Internal linkage: a copy compiled for one instruction set must not be the one the linker keeps for all.
static constexpr std::int64_t round_up_to_lanes(std::int64_t n) { return (n + kLanes - 1) / kLanes * kLanes; }

/// Doubles of scratch memory that the kinematic kernels need: seven time series and four padded rows.
static constexpr std::int64_t kinematics_scratch(const MotionShape& shape) {
  return 7 * round_up_to_lanes(shape.frames) + 4 * (round_up_to_lanes(3 * shape.joints) + 2 * kLanes);
}

/// Doubles of scratch memory for the obstacles of sixteen frames.
static constexpr std::int64_t obstacle_scratch(std::int64_t count) { return count * kObstacleParameters * kLanes; }

/// Doubles of scratch memory for the fused kernel: time series, obstacles, a list of joints, and one flag a joint.
static constexpr std::int64_t guidance_scratch(const MotionShape& shape, std::int64_t obstacles) {
  return 14 * round_up_to_lanes(shape.frames) + obstacle_scratch(obstacles) + 2 * shape.joints;
}

/// Columns of a banded matrix that are eliminated at once.
constexpr std::int64_t kPanel = 4;

/// Doubles of a column of a banded matrix: whole blocks from any of its entries on, or a panel's width further.
static constexpr std::int64_t banded_stride(std::int64_t reach) { return round_up_to_lanes(reach + kPanel + kLanes); }

/// Doubles of scratch memory for a banded matrix.
static constexpr std::int64_t banded_scratch(std::int64_t unknowns, std::int64_t reach) {
  return unknowns * banded_stride(reach);
}

/// Doubles of scratch memory for a clip's banded system, entries up to `reach` apart, with its right side.
static constexpr std::int64_t banded_system_scratch(std::int64_t unknowns, std::int64_t reach) {
  return banded_scratch(unknowns, reach) + unknowns + banded_stride(reach);
}

/// Stretches of a clip that a system of its joints keeps abreast: doubles of the widest register.
constexpr std::int64_t kAbreast = 8;

/// Pairs of frames in such a stretch.
static constexpr std::int64_t clip_frame_pairs(std::int64_t frames) {
  return (frames + 2 * kAbreast - 1) / (2 * kAbreast);
}

/// Doubles of scratch memory for a system of a clip's joints. Of every frame: blocks, right side, ties, flags; of every
/// other one: five vectors, one of them with a row more. And what aligns them.
static constexpr std::int64_t clip_system_scratch(std::int64_t frames, std::int64_t joints) {
  return ((12 + 5) * clip_frame_pairs(frames) + 1) * 3 * joints * kAbreast + kAbreast;
}

/// Doubles of scratch memory for the bones of single frames: how joints yield, bones, a system of bones, a move.
static constexpr std::int64_t frame_bones_scratch(std::int64_t joints) {
  return banded_scratch(joints, joints - 1) + 3 * joints * (joints + banded_stride(joints - 1)) + 4 * joints +
         banded_system_scratch(joints, joints - 1) + 3 * joints;
}

/// Numbers of a rotation matrix.
constexpr std::int64_t kRotationRows = 9;

/// Doubles of scratch memory for local rotations: those of all bones in sixteen frames, before and after.
static constexpr std::int64_t swing_scratch(std::int64_t joints) { return 2 * joints * kRotationRows * kLanes; }

const KernelTable& active_kernels();

}  // namespace controlmm
