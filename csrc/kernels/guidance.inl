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
    is_controlled = reinterpret_cast<std::uint8_t*>(memory + 14 * padded + obstacle_scratch(obstacles));
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
  std::uint8_t* is_controlled;  // one flag a joint
};

// 1 in each byte of a word that is not 0.
inline std::uint64_t nonzero_bytes(const std::uint8_t* at) {
  constexpr std::uint64_t kLow = 0x7f7f7f7f7f7f7f7fu;
  std::uint64_t word;
  __builtin_memcpy(&word, at, 8);
  return ((((word & kLow) + kLow) | word) & ~kLow) >> 7;
}

// Number of masked frames or (frame, coordinate) pairs of one joint.
inline std::int64_t count_masked(const std::uint8_t* mask, std::int64_t frame, std::int64_t coord, std::int64_t frames,
                                 bool is_per_joint) {
  std::int64_t joints = 0, coords = 0, t = 0;
  constexpr std::uint64_t kOnes = 0x0101010101010101u;
  for (; frame == 1 && t + 8 <= frames; t += 8) {  // eight booleans a word; their sum collects in the top byte
    const std::uint64_t x = nonzero_bytes(mask + t);
    const std::uint64_t y = coord == 0 ? x : nonzero_bytes(mask + coord + t);
    const std::uint64_t z = coord == 0 ? x : nonzero_bytes(mask + 2 * coord + t);
    joints += static_cast<std::int64_t>((x | y | z) * kOnes >> 56);
    coords += static_cast<std::int64_t>((x + y + z) * kOnes >> 56);
  }
  for (; t < frames; ++t) {
    const std::uint8_t* at = mask + t * frame;
    const int x = at[0] != 0, y = at[coord] != 0, z = at[2 * coord] != 0;
    joints += x | y | z;
    coords += x + y + z;
  }
  return is_per_joint ? joints : coords;
}

template <class T>
std::int64_t find_controlled_joints(const GuidanceArgs<T>& args, std::int64_t clip, std::uint8_t* is_controlled) {
  const Strided4<const std::uint8_t>& m = args.mask;
  std::int64_t total = 0;
  for (std::int64_t j = 0; j < args.shape.joints; ++j) {
    const std::uint8_t* at = m.data + clip * m.clip + j * m.joint;
    const std::int64_t count = count_masked(at, m.frame, m.coord, args.shape.frames, args.norm == Norm::l2);
    is_controlled[j] = count > 0;
    total += count;
  }
  return total;
}

template <class T>
CONTROLMM_INLINE Mask<T> load_bytes_as_mask(const std::uint8_t* p, std::int64_t stride, std::int64_t n) {
  using Int = typename IntOf<T>::type;
  Int lanes[kLanes] = {};
  if (stride == 1 && n == kLanes) {
    for (std::int64_t i = 0; i < kLanes; ++i) lanes[i] = p[i];
  } else {
    for (std::int64_t i = 0; i < n; ++i) lanes[i] = p[i * stride];
  }
  return zeros<Int>() < load(lanes);
}

// Sixteen frames of a clip: the turn and place of the root, and what the joints send back to it.
template <class T>
struct FrameBlock {
  std::int64_t first, count;
  Lanes<T> cos, sin, x, z;
  Lanes<T> grad_x, grad_z, grad_yaw;
};

template <class T>
CONTROLMM_INLINE FrameBlock<T> load_block(const GuidanceScratch<T>& scratch, std::int64_t first, std::int64_t frames) {
  const std::int64_t count = frames - first < kLanes ? frames - first : kLanes;
  const auto &turn = scratch.turn, &sums = scratch.sums;
  return {first,
          count,
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
    store(scratch.turn.cos + t, load_narrowed<T>(scratch.heading.cos + t));
    store(scratch.turn.sin + t, load_narrowed<T>(scratch.heading.sin + t));
    store(scratch.turn.x + t, load_narrowed<T>(scratch.heading.x + t));
    store(scratch.turn.z + t, load_narrowed<T>(scratch.heading.z + t));
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

// Three neighbouring channels of a decoder output, de-normalised.
template <class T>
CONTROLMM_INLINE Lanes<T> load_channel(const GuidanceArgs<T>& args, std::int64_t clip, std::int64_t channel,
                                       const FrameBlock<T>& block) {
  const Strided3<const T>& d = args.decoded;
  const T* at = d.data + clip * d.clip + channel * d.channel + block.first * d.frame;
  return load_strided(at, d.frame, block.count) * broadcast(args.std[channel]) + broadcast(args.mean[channel]);
}

template <class T>
CONTROLMM_INLINE void store_channel(const GuidanceArgs<T>& args, std::int64_t clip, std::int64_t channel,
                                    const FrameBlock<T>& block, const Lanes<T>& gradient) {
  const Strided3<T>& g = args.gradient;
  T* at = g.data + clip * g.clip + channel * g.channel + block.first * g.frame;
  store_strided(at, g.frame, block.count, gradient * broadcast(args.std[channel]));
}

template <class T>
struct ClipTerms {
  std::int64_t clip;
  Lanes<T> control_scale, obstacle_scale;
  Mask<T> in_length;
  Lanes<double> control_sum, obstacle_sum;
};

template <class T>
CONTROLMM_INLINE Points<T> control_gradient(const GuidanceArgs<T>& args, const FrameBlock<T>& block, std::int64_t joint,
                                            const Points<T>& p, ClipTerms<T>& terms) {
  const Strided4<const std::uint8_t>& m = args.mask;
  const Lanes<T> zero = zeros<T>();
  const std::uint8_t* at = m.data + terms.clip * m.clip + block.first * m.frame + joint * m.joint;
  PointMask<T> mask{};
  mask.x = load_bytes_as_mask<T>(at, m.frame, block.count);
  mask.y = m.coord == 0 ? mask.x : load_bytes_as_mask<T>(at + m.coord, m.frame, block.count);
  mask.z = m.coord == 0 ? mask.x : load_bytes_as_mask<T>(at + 2 * m.coord, m.frame, block.count);
  if (!any(mask.x | mask.y | mask.z)) return {zero, zero, zero};
  const Strided4<const T>& t = args.targets;
  const T* target = t.data + terms.clip * t.clip + block.first * t.frame + joint * t.joint;
  const Points<T> d = masked_difference(p, load_points(target, t.frame, t.coord, block.count), mask);
  terms.control_sum = terms.control_sum + to_double(penalty(d, args.norm));
  const Points<T> g = penalty_gradient(d, args.norm, terms.control_scale);
  return {select(mask.x, g.x, zero), select(mask.y, g.y, zero), select(mask.z, g.z, zero)};
}

template <class T>
CONTROLMM_INLINE Points<T> joint_gradient(const GuidanceArgs<T>& args, const GuidanceScratch<T>& scratch,
                                          const FrameBlock<T>& block, std::int64_t joint, const Points<T>& p,
                                          ClipTerms<T>& terms) {
  Points<T> g = {zeros<T>(), zeros<T>(), zeros<T>()};
  if (scratch.is_controlled[joint]) g = control_gradient(args, block, joint, p, terms);
  if (args.obstacles.count == 0 || !args.obstacles.is_active[joint] || !any(terms.in_length)) return g;
  const Collision<T> c = collide_with_all(args.obstacles, scratch.staged, joint, p, terms.in_length);
  terms.obstacle_sum = terms.obstacle_sum + to_double(c.depth);
  return {g.x + c.gradient.x * terms.obstacle_scale, g.y + c.gradient.y * terms.obstacle_scale,
          g.z + c.gradient.z * terms.obstacle_scale};
}

template <class T>
CONTROLMM_INLINE void guide_root(const GuidanceArgs<T>& args, const GuidanceScratch<T>& scratch, FrameBlock<T>& block,
                                 ClipTerms<T>& terms) {
  const Points<T> p = {block.x, load_channel(args, terms.clip, 3, block), block.z};
  const Points<T> g = joint_gradient(args, scratch, block, 0, p, terms);
  store_channel(args, terms.clip, 3, block, g.y);
  block.grad_x = block.grad_x + g.x;
  block.grad_z = block.grad_z + g.z;
}

template <class T>
CONTROLMM_INLINE void guide_joint(const GuidanceArgs<T>& args, const GuidanceScratch<T>& scratch, FrameBlock<T>& block,
                                  std::int64_t joint, ClipTerms<T>& terms) {
  const std::int64_t channel = 4 + 3 * (joint - 1), clip = terms.clip;
  const Lanes<T> lx = load_channel(args, clip, channel, block), lz = load_channel(args, clip, channel + 2, block);
  const Points<T> p = {block.cos * lx - block.sin * lz + block.x, load_channel(args, clip, channel + 1, block),
                       block.sin * lx + block.cos * lz + block.z};
  const Points<T> g = joint_gradient(args, scratch, block, joint, p, terms);
  const Lanes<T> local_x = block.cos * g.x + block.sin * g.z, local_z = block.cos * g.z - block.sin * g.x;
  store_channel(args, clip, channel, block, local_x);
  store_channel(args, clip, channel + 1, block, g.y);
  store_channel(args, clip, channel + 2, block, local_z);
  block.grad_x = block.grad_x + g.x;
  block.grad_z = block.grad_z + g.z;
  block.grad_yaw = block.grad_yaw + (lx * local_z - lz * local_x);
}

template <class T>
void zero_joint(const GuidanceArgs<T>& args, std::int64_t clip, std::int64_t joint) {
  const Strided3<T>& g = args.gradient;
  T* at = g.data + clip * g.clip + (4 + 3 * (joint - 1)) * g.channel;
  for (std::int64_t c = 0; c < 3; ++c, at += g.channel) {
    if (g.frame == 1) {
      __builtin_memset(at, 0, static_cast<std::size_t>(args.shape.frames) * sizeof(T));
      continue;
    }
    for (std::int64_t t = 0; t < args.shape.frames; ++t) at[t * g.frame] = 0;
  }
}

// Joint by joint over all frames: each channel is one long run of memory, which prefetching needs.
template <class T>
void guide_without_obstacles(const GuidanceArgs<T>& args, const GuidanceScratch<T>& scratch, ClipTerms<T>& terms) {
  const std::int64_t frames = args.shape.frames;
  for (std::int64_t j = 0; j < args.shape.joints; ++j) {
    if (j > 0 && !scratch.is_controlled[j]) continue;
    for (std::int64_t t = 0; t < frames; t += kLanes) {
      FrameBlock<T> block = load_block(scratch, t, frames);
      if (j == 0)
        guide_root(args, scratch, block, terms);
      else
        guide_joint(args, scratch, block, j, terms);
      store_sums(block, scratch);
    }
  }
}

// Frames in the outer loop: the obstacles of sixteen frames stay in the innermost cache for all joints.
template <class T>
void guide_among_obstacles(const GuidanceArgs<T>& args, const GuidanceScratch<T>& scratch, ClipTerms<T>& terms) {
  const std::int64_t frames = args.shape.frames, length = args.obstacles.lengths[terms.clip];
  for (std::int64_t t = 0; t < frames; t += kLanes) {
    FrameBlock<T> block = load_block(scratch, t, frames);
    terms.in_length = first_lanes<T>(length - t < block.count ? length - t : block.count);
    if (t < length) stage_obstacles(args.obstacles, terms.clip, t, block.count, scratch.staged);
    guide_root(args, scratch, block, terms);
    for (std::int64_t j = 1; j < args.shape.joints; ++j)
      if (scratch.is_controlled[j] || args.obstacles.is_active[j]) guide_joint(args, scratch, block, j, terms);
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
  const std::int64_t controlled = find_controlled_joints(args, clip, scratch.is_controlled);
  const double control_scale = controlled == 0 ? 0 : 1 / static_cast<double>(controlled);
  const double obstacle_scale = has_obstacles ? args.obstacle_scales[clip] : 0;
  ClipTerms<T> terms{clip,
                     broadcast(static_cast<T>(control_scale)),
                     broadcast(static_cast<T>(obstacle_scale)),
                     Mask<T>{},
                     zeros<double>(),
                     zeros<double>()};
  if (has_obstacles)
    guide_among_obstacles(args, scratch, terms);
  else
    guide_without_obstacles(args, scratch, terms);
  for (std::int64_t j = 1; j < args.shape.joints; ++j)
    if (!scratch.is_controlled[j] && !(has_obstacles && args.obstacles.is_active[j])) zero_joint(args, clip, j);
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
