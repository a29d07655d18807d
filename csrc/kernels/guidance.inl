// Losses and their gradient straight from a decoder's output, lanes = frames: de-normalise, rotate, compare, rotate
// back. Nothing of the size of the joints is stored, and joints without control or obstacle are skipped.

template <class T>
struct GuidanceScratch {
  GuidanceScratch(double* memory, const MotionShape& shape, std::int64_t obstacles) {
    const std::int64_t padded = round_up_to_lanes(shape.frames);
    heading = {memory, memory + padded, memory + 2 * padded, memory + 3 * padded};
    root = {memory + 4 * padded, memory + 5 * padded, memory + 6 * padded};
    T* series[7];
    for (int i = 0; i < 7; ++i) series[i] = reinterpret_cast<T*>(memory + (7 + i) * padded);
    turn = {series[0], series[1], series[2], series[3]};
    sums = {series[4], series[5], series[6]};
    staged = reinterpret_cast<T*>(memory + 14 * padded);
    guided = reinterpret_cast<std::int64_t*>(memory + 14 * padded + obstacle_scratch(obstacles));
    controlled = reinterpret_cast<Controlled*>(guided + shape.joints);
  }
  struct Turn {
    T *cos, *sin, *x, *z;
  };
  struct Sums {
    T *x, *z, *yaw;
  };
  Heading heading;
  RootGradient root;
  Turn turn;  // heading and root path in the precision of the joints
  Sums sums;  // what the joints of each frame have sent to the root so far
  T* staged;
  std::int64_t* guided;    // joints that have a gradient
  Controlled* controlled;  // one a joint
};

// Sixteen frames of a clip: the turn and place of the root, and what the joints send back to it.
template <class T>
struct FrameBlock {
  std::int64_t first, count;
  bool is_run;  // sixteen neighbours in every argument
  Lanes<T> cos, sin, x, z;
  Lanes<T> grad_x, grad_z, grad_yaw;
};

template <class T>
CONTROLMM_INLINE FrameBlock<T> load_block(const GuidanceScratch<T>& scratch, std::int64_t first, std::int64_t frames,
                                          bool are_neighbours) {
  const std::int64_t count = lanes_left(frames, first);
  const auto &turn = scratch.turn, &sums = scratch.sums;
  return {first,
          count,
          are_neighbours && count == kLanes,
          load(turn.cos + first),
          load(turn.sin + first),
          load(turn.x + first),
          load(turn.z + first),
          load(sums.x + first),
          load(sums.z + first),
          load(sums.yaw + first)};
}

template <class T>
CONTROLMM_INLINE void store_sums(const FrameBlock<T>& block, const GuidanceScratch<T>& scratch) {
  store(scratch.sums.x + block.first, block.grad_x);
  store(scratch.sums.z + block.first, block.grad_z);
  store(scratch.sums.yaw + block.first, block.grad_yaw);
}

template <class T>
void start_clip(const GuidanceScratch<T>& scratch, std::int64_t frames) {
  const Lanes<T> zero = zeros<T>();
  for (std::int64_t t = 0; t < frames; t += kLanes) {
    store(scratch.turn.cos + t, narrowed<T>(load(scratch.heading.cos + t)));
    store(scratch.turn.sin + t, narrowed<T>(load(scratch.heading.sin + t)));
    store(scratch.turn.x + t, narrowed<T>(load(scratch.heading.x + t)));
    store(scratch.turn.z + t, narrowed<T>(load(scratch.heading.z + t)));
    for (T* sum : {scratch.sums.x, scratch.sums.z, scratch.sums.yaw}) store(sum + t, zero);
  }
}

template <class T>
void finish_root_sums(const GuidanceScratch<T>& scratch, std::int64_t frames) {
  for (std::int64_t t = 0; t < frames; t += kLanes) {
    store(scratch.root.x + t, to_double(load(scratch.sums.x + t)));
    store(scratch.root.z + t, to_double(load(scratch.sums.z + t)));
    store(scratch.root.yaw + t, to_double(load(scratch.sums.yaw + t)));
  }
}

// Of three. The three in front of the joints belong to the root: two velocities and its height.
inline std::int64_t first_channel(std::int64_t joint) { return 1 + 3 * joint; }

// What of a clip belongs to one joint, in every argument: three runs of memory each, found once and kept in registers.
template <class T>
struct JointRuns {
  JointRuns(const GuidanceArgs<T>& args, std::int64_t clip, std::int64_t joint, Controlled extent)
      : decoded(run_of(args.decoded, clip, joint)),
        gradient(run_of(args.gradient, clip, joint)),
        targets(run_of(args.targets, clip, joint)),
        mask(run_of(args.mask, clip, joint)),
        controlled(extent),
        norm(args.norm) {
    for (std::int64_t c = 0; c < 3; ++c) {
      scale[c] = args.std[first_channel(joint) + c];
      shift[c] = args.mean[first_channel(joint) + c];
    }
  }

  template <class V>
  struct Run {
    V* data;
    std::int64_t frame, step;  // to the next frame, and to the next of the three
  };
  template <class V>
  static Run<V> run_of(const Strided3<V>& a, std::int64_t clip, std::int64_t joint) {
    return {a.data + clip * a.clip + first_channel(joint) * a.channel, a.frame, a.channel};
  }
  template <class V>
  static Run<V> run_of(const Strided4<V>& a, std::int64_t clip, std::int64_t joint) {
    return {a.data + clip * a.clip + joint * a.joint, a.frame, a.coord};
  }

  // Nine runs are more than the processor's own prefetching follows.
  CONTROLMM_INLINE void prefetch(std::int64_t first) const {
    for (std::int64_t c = 0; c < 3; ++c) {
      __builtin_prefetch(decoded.data + first + c * decoded.step);
      __builtin_prefetch(targets.data + first + c * targets.step);
      __builtin_prefetch(gradient.data + first + c * gradient.step, 1);
    }
  }

  Run<const T> decoded;
  Run<T> gradient;
  Run<const T> targets;
  Run<const std::uint8_t> mask;
  Controlled controlled;
  Norm norm;
  T scale[3], shift[3];  // of the decoded channels
};

// Sixteen frames of a run. Where they are neighbours in every argument, loads need no care for strides or for the end
// of the clip.
template <bool kIsRun, class T>
CONTROLMM_INLINE Lanes<T> load_run(const T* run, std::int64_t stride, const FrameBlock<T>& block) {
  if constexpr (kIsRun) return load(run + block.first);
  return load_strided(run + block.first * stride, stride, block.count);
}
template <bool kIsRun, class T>
CONTROLMM_INLINE Lanes<T> load_channel(const JointRuns<T>& runs, std::int64_t c, const FrameBlock<T>& block) {
  return load_run<kIsRun>(runs.decoded.data + c * runs.decoded.step, runs.decoded.frame, block) *
             broadcast(runs.scale[c]) +
         broadcast(runs.shift[c]);
}
template <bool kIsRun, class T>
CONTROLMM_INLINE void store_channel(const JointRuns<T>& runs, std::int64_t c, const FrameBlock<T>& block,
                                    const Lanes<T>& gradient) {
  T* run = runs.gradient.data + c * runs.gradient.step;
  const Lanes<T> scaled = gradient * broadcast(runs.scale[c]);
  if constexpr (kIsRun) return store(run + block.first, scaled);
  store_strided(run + block.first * runs.gradient.frame, runs.gradient.frame, block.count, scaled);
}
template <bool kIsRun, class T>
CONTROLMM_INLINE Mask<T> load_mask_run(const JointRuns<T>& runs, std::int64_t c, const FrameBlock<T>& block) {
  const std::uint8_t* run = runs.mask.data + c * runs.mask.step;
  if constexpr (kIsRun) return load_mask<T>(run + block.first);
  return load_mask<T>(run + block.first * runs.mask.frame, runs.mask.frame, block.count);
}

template <class T>
struct ClipTerms {
  Lanes<T> control_scale, obstacle_scale;
  Mask<T> in_length;
  Lanes<double> control_sum, obstacle_sum;
};

template <bool kIsRun, class T>
CONTROLMM_INLINE Points<T> control_gradient(const JointRuns<T>& runs, const FrameBlock<T>& block, const Points<T>& p,
                                            ClipTerms<T>& terms) {
  const auto target = [&](std::int64_t c) __attribute__((always_inline)) {
    return load_run<kIsRun>(runs.targets.data + c * runs.targets.step, runs.targets.frame, block);
  };
  if (kIsRun && runs.controlled == Controlled::everywhere) {
    const Points<T> d = {p.x - target(0), p.y - target(1), p.z - target(2)};
    const Penalty<T> penalty = penalty_of(d, runs.norm, terms.control_scale);
    terms.control_sum = terms.control_sum + to_double(penalty.value);
    return penalty.gradient;
  }
  const Lanes<T> zero = zeros<T>();
  PointMask<T> mask{};
  mask.x = load_mask_run<kIsRun>(runs, 0, block);
  mask.y = load_mask_run<kIsRun>(runs, 1, block);
  mask.z = load_mask_run<kIsRun>(runs, 2, block);
  if (!any(mask.x | mask.y | mask.z)) return {zero, zero, zero};
  const Points<T> d = masked_difference(p, Points<T>{target(0), target(1), target(2)}, mask);
  const Penalty<T> penalty = penalty_of(d, runs.norm, terms.control_scale);
  terms.control_sum = terms.control_sum + to_double(penalty.value);
  const Points<T>& g = penalty.gradient;
  return {select(mask.x, g.x, zero), select(mask.y, g.y, zero), select(mask.z, g.z, zero)};
}

// The obstacles that a joint may meet; null where there are none.
template <class T>
struct Hindrance {
  const ObstacleArgs<T>* obstacles;
  const T* staged;
  std::int64_t joint;
};

template <bool kIsRun, class T>
CONTROLMM_INLINE Points<T> joint_gradient(const JointRuns<T>& runs, const FrameBlock<T>& block, const Points<T>& p,
                                          const Hindrance<T>& hindrance, ClipTerms<T>& terms) {
  Points<T> g = {zeros<T>(), zeros<T>(), zeros<T>()};
  if (runs.controlled != Controlled::nowhere) g = control_gradient<kIsRun>(runs, block, p, terms);
  if (hindrance.obstacles == nullptr) return g;
  Collision<T> c;
  collide_with_all(*hindrance.obstacles, hindrance.staged, hindrance.joint, p, terms.in_length, c);
  terms.obstacle_sum = terms.obstacle_sum + to_double(c.depth);
  return {g.x + c.gradient.x * terms.obstacle_scale, g.y + c.gradient.y * terms.obstacle_scale,
          g.z + c.gradient.z * terms.obstacle_scale};
}

// The root lies on its path; of its three channels only the last, the height, is a position.
template <bool kIsRun, class T>
CONTROLMM_INLINE void guide_root(const JointRuns<T>& runs, FrameBlock<T>& block, const Hindrance<T>& hindrance,
                                 ClipTerms<T>& terms) {
  const Points<T> p = {block.x, load_channel<kIsRun>(runs, 2, block), block.z};
  const Points<T> g = joint_gradient<kIsRun>(runs, block, p, hindrance, terms);
  store_channel<kIsRun>(runs, 2, block, g.y);
  block.grad_x = block.grad_x + g.x;
  block.grad_z = block.grad_z + g.z;
}

template <bool kIsRun, class T>
CONTROLMM_INLINE void guide_limb(const JointRuns<T>& runs, FrameBlock<T>& block, const Hindrance<T>& hindrance,
                                 ClipTerms<T>& terms) {
  const Lanes<T> lx = load_channel<kIsRun>(runs, 0, block), lz = load_channel<kIsRun>(runs, 2, block);
  const Points<T> p = {block.cos * lx - block.sin * lz + block.x, load_channel<kIsRun>(runs, 1, block),
                       block.sin * lx + block.cos * lz + block.z};
  const Points<T> g = joint_gradient<kIsRun>(runs, block, p, hindrance, terms);
  const Lanes<T> local_x = block.cos * g.x + block.sin * g.z, local_z = block.cos * g.z - block.sin * g.x;
  store_channel<kIsRun>(runs, 0, block, local_x);
  store_channel<kIsRun>(runs, 1, block, g.y);
  store_channel<kIsRun>(runs, 2, block, local_z);
  block.grad_x = block.grad_x + g.x;
  block.grad_z = block.grad_z + g.z;
  block.grad_yaw = block.grad_yaw + (lx * local_z - lz * local_x);
}

template <class T>
CONTROLMM_INLINE void guide_joint(const JointRuns<T>& runs, FrameBlock<T>& block, bool is_root,
                                  const Hindrance<T>& hindrance, ClipTerms<T>& terms) {
  if (is_root) {
    if (block.is_run) return guide_root<true>(runs, block, hindrance, terms);
    return guide_root<false>(runs, block, hindrance, terms);
  }
  if (block.is_run) return guide_limb<true>(runs, block, hindrance, terms);
  return guide_limb<false>(runs, block, hindrance, terms);
}

template <class T>
void zero_joint(const GuidanceArgs<T>& args, std::int64_t clip, std::int64_t joint) {
  const Strided3<T>& g = args.gradient;
  T* at = g.data + clip * g.clip + first_channel(joint) * g.channel;
  for (std::int64_t c = 0; c < 3; ++c, at += g.channel) {
    if (g.frame == 1) {
      __builtin_memset(at, 0, static_cast<std::size_t>(args.shape.frames) * sizeof(T));
      continue;
    }
    for (std::int64_t t = 0; t < args.shape.frames; ++t) at[t * g.frame] = 0;
  }
}

// Lists the joints that have a gradient, the root always, and zeroes the others'.
template <class T>
std::int64_t list_guided_joints(const GuidanceArgs<T>& args, std::int64_t clip, const GuidanceScratch<T>& scratch) {
  std::int64_t guided = 0;
  for (std::int64_t j = 0; j < args.shape.joints; ++j) {
    const bool meets_obstacles = args.obstacles.count != 0 && args.obstacles.is_active[j];
    if (j == 0 || meets_obstacles || scratch.controlled[j] != Controlled::nowhere)
      scratch.guided[guided++] = j;
    else
      zero_joint(args, clip, j);
  }
  return guided;
}

constexpr std::int64_t kJointsAhead = 2;  // far enough for memory to arrive, near enough to stay in the innermost cache

// Joint by joint over all frames: each channel is one long run of memory.
template <class T>
void guide_without_obstacles(const GuidanceArgs<T>& args, std::int64_t clip, const GuidanceScratch<T> scratch,
                             std::int64_t guided, ClipTerms<T>& out) {
  ClipTerms<T> terms = out;
  const std::int64_t frames = args.shape.frames;
  const bool are_neighbours = args.frames_are_neighbours;
  for (std::int64_t i = 0; i < guided; ++i) {
    const std::int64_t joint = scratch.guided[i];
    const std::int64_t ahead = scratch.guided[i + kJointsAhead < guided ? i + kJointsAhead : guided - 1];
    const JointRuns<T> runs(args, clip, joint, scratch.controlled[joint]);
    const JointRuns<T> next(args, clip, ahead, Controlled::nowhere);
    for (std::int64_t t = 0; t < frames; t += kLanes) {
      if (are_neighbours) next.prefetch(t);
      FrameBlock<T> block = load_block(scratch, t, frames, are_neighbours);
      guide_joint(runs, block, joint == 0, Hindrance<T>{nullptr, nullptr, joint}, terms);
      store_sums(block, scratch);
    }
  }
  out = terms;
}

// Frames in the outer loop: the obstacles of sixteen frames stay in the innermost cache for all joints.
template <class T>
void guide_among_obstacles(const GuidanceArgs<T>& args, std::int64_t clip, const GuidanceScratch<T> scratch,
                           std::int64_t guided, ClipTerms<T>& terms) {
  const ObstacleArgs<T>& obstacles = args.obstacles;
  const std::int64_t frames = args.shape.frames, length = obstacles.lengths[clip];
  for (std::int64_t t = 0; t < frames; t += kLanes) {
    FrameBlock<T> block = load_block(scratch, t, frames, args.frames_are_neighbours);
    terms.in_length = first_lanes<T>(length - t < block.count ? length - t : block.count);
    if (t < length) stage_obstacles(obstacles, clip, t, block.count, scratch.staged);
    for (std::int64_t i = 0; i < guided; ++i) {
      const std::int64_t joint = scratch.guided[i];
      const JointRuns<T> runs(args, clip, joint, scratch.controlled[joint]);
      if (args.frames_are_neighbours) runs.prefetch(t + kLanes);
      const bool meets_obstacles = t < length && obstacles.is_active[joint];
      guide_joint(runs, block, joint == 0, Hindrance<T>{meets_obstacles ? &obstacles : nullptr, scratch.staged, joint},
                  terms);
    }
    store_sums(block, scratch);
  }
}

template <class T>
void guide_clip(const GuidanceArgs<T>& args, std::int64_t clip, const GuidanceScratch<T>& scratch) {
  const std::int64_t frames = args.shape.frames;
  const Strided3<const T>& d = args.decoded;
  const Strided3<T>& g = args.gradient;
  RootChannels root;
  for (int c = 0; c < 3; ++c) {
    root.scale[c] = static_cast<double>(args.std[c]);
    root.shift[c] = static_cast<double>(args.mean[c]);
  }
  compute_heading(d.data + clip * d.clip, d.frame, d.channel, frames, root, scratch.heading);
  start_clip(scratch, frames);

  const bool has_obstacles = args.obstacles.count != 0;
  const std::int64_t controlled = find_controlled_joints(args, clip, scratch.controlled);
  const double control_scale = controlled == 0 ? 0 : 1 / static_cast<double>(controlled);
  const double obstacle_scale = has_obstacles ? args.obstacle_scales[clip] : 0;
  ClipTerms<T> terms{broadcast(static_cast<T>(control_scale)), broadcast(static_cast<T>(obstacle_scale)), Mask<T>{},
                     zeros<double>(), zeros<double>()};
  const std::int64_t guided = list_guided_joints(args, clip, scratch);
  if (has_obstacles)
    guide_among_obstacles(args, clip, scratch, guided, terms);
  else
    guide_without_obstacles(args, clip, scratch, guided, terms);
  finish_root_sums(scratch, frames);
  heading_backward(d.data + clip * d.clip, d.frame, d.channel, frames, root, scratch.heading, scratch.root,
                   g.data + clip * g.clip, g.frame, g.channel);
  args.loss[clip] = static_cast<T>(sum(terms.control_sum) * control_scale + sum(terms.obstacle_sum) * obstacle_scale);
}

template <class T>
void guidance(const GuidanceArgs<T>& args, ClipRange clips, double* memory) {
  const GuidanceScratch<T> scratch(memory, args.shape, args.obstacles.count);
  for (std::int64_t clip = clips.begin; clip < clips.end; ++clip) guide_clip(args, clip, scratch);
}
