// Frame-major kinematics. Joint j > 0, coordinate c, is output k = 3 j + c and input k + 1, so a frame is one run of
// values whose role (x, y, z) repeats with period 3: x and z lanes fetch their partner two places further on or back.
// No transposes, no gathers.

template <class T>
struct Roles {
  Mask<T> x, z, y_or_none;
};

// Roles of sixteen consecutive outputs, the first of which is coordinate `phase`; lanes from `valid` on have none.
template <class T>
CONTROLMM_INLINE Roles<T> roles_from(std::int64_t phase, std::int64_t valid) {
  std::uint8_t x[kLanes], z[kLanes], y_or_none[kLanes];
  for (std::int64_t i = 0; i < kLanes; ++i) {
    const std::int64_t role = i < valid ? (phase + i) % 3 : 1;
    x[i] = role == 0;
    z[i] = role == 2;
    y_or_none[i] = role == 1;
  }
  return {load_mask<T>(x), load_mask<T>(z), load_mask<T>(y_or_none)};
}

// The blocks of sixteen that cover joints 1 .. J-1 of a frame.
template <class T>
struct FrameBlocks {
  explicit FrameBlocks(std::int64_t joints)
      : values(3 * (joints - 1)),
        count(round_up_to_lanes(values) / kLanes),
        roles{roles_from<T>(0, kLanes), roles_from<T>(1, kLanes), roles_from<T>(2, kLanes),
              roles_from<T>((count - 1) * kLanes % 3, values - (count - 1) * kLanes)} {}

  const Roles<T>& of(std::int64_t block) const { return roles[block == count - 1 ? 3 : block % 3]; }

  std::int64_t values, count;
  Roles<T> roles[4];
};

// First addresses past what a frame's blocks touch, counted from the start of its row.
inline std::int64_t row_reach(const MotionShape& shape) { return round_up_to_lanes(3 * shape.joints) + 2 * kLanes; }

template <class T>
struct Scratch {
  explicit Scratch(double* memory, const MotionShape& shape) {
    const std::int64_t padded = round_up_to_lanes(shape.frames), row = row_reach(shape);
    heading = {memory, memory + padded, memory + 2 * padded, memory + 3 * padded};
    gradient = {memory + 4 * padded, memory + 5 * padded, memory + 6 * padded};
    for (int i = 0; i < 4; ++i) rows[i] = reinterpret_cast<T*>(memory + 7 * padded + i * row);
    for (std::int64_t i = 0; i < row; ++i)
      for (T* padded_row : rows) padded_row[i] = 0;
  }
  Heading heading;
  RootGradient gradient;
  T* rows[4];
};

template <class T>
CONTROLMM_INLINE void rotate_frame(const T* in, T* out, T cosine, T sine, T root_x, T root_z,
                                   const FrameBlocks<T>& blocks) {
  const Lanes<T> c = broadcast(cosine), s = broadcast(sine), px = broadcast(root_x), pz = broadcast(root_z);
  out[0] = root_x;
  out[1] = in[3];
  out[2] = root_z;
  for (std::int64_t b = 0; b < blocks.count; ++b) {
    const std::int64_t k = 3 + b * kLanes;
    const Roles<T>& role = blocks.of(b);
    const Lanes<T> own = load(in + k + 1);
    const Lanes<T> turned = s * select(role.x, zeros<T>() - load(in + k + 3), load(in + k - 1));
    const Lanes<T> moved = c * own + turned + select(role.x, px, pz);
    store(out + k, select(role.y_or_none, own, moved));
  }
}

template <class T>
void copy_row(const T* from, std::int64_t stride, std::int64_t n, T* to) {
  for (std::int64_t i = 0; i < n; ++i) to[i] = from[i * stride];
}

// Rows lie far apart in memory, and only their fronts are read: more than the processor's own prefetching sees through.
constexpr std::int64_t kRowsAhead = 2;

template <class T>
CONTROLMM_INLINE void prefetch_row(const T* row, std::int64_t values) {
  for (std::int64_t i = 0; i < values; i += kLanes) __builtin_prefetch(row + i);
}
template <class T>
void recover_clip(const RecoverArgs<T>& args, std::int64_t clip, const FrameBlocks<T>& blocks, Scratch<T>& scratch) {
  const MotionShape& shape = args.shape;
  const Strided3<const T>& f = args.features;
  const T* features = f.data + clip * f.clip;
  T* joints = args.joints + clip * shape.frames * shape.joints * 3;
  const Heading& h = scratch.heading;
  compute_heading(features, f.frame, f.channel, shape.frames, kDenormalised, h);

  const std::int64_t channels = 4 + blocks.values, values = 3 * shape.joints;
  // Blocks read and write a little past a row; that is safe while another row of the same clip follows.
  const bool reads_in_place = f.channel == 1 && f.frame >= channels && f.frame + channels >= row_reach(shape);
  const bool writes_in_place = 2 * values >= 3 + blocks.count * kLanes;
  for (std::int64_t t = 0; t < shape.frames; ++t) {
    const bool is_last = t + 1 == shape.frames;
    const T* in = features + t * f.frame;
    T* out = joints + t * values;
    if (!reads_in_place || is_last) {
      copy_row(in, f.channel, channels, scratch.rows[0]);
      in = scratch.rows[0];
    }
    T* target = writes_in_place && !is_last ? out : scratch.rows[1];
    if (reads_in_place) prefetch_row(in + kRowsAhead * f.frame, channels);
    rotate_frame(in, target, static_cast<T>(h.cos[t]), static_cast<T>(h.sin[t]), static_cast<T>(h.x[t]),
                 static_cast<T>(h.z[t]), blocks);
    if (target != out) copy_row(target, 1, values, out);
  }
}

template <class T>
void recover_joints(const RecoverArgs<T>& args, ClipRange clips, double* memory) {
  const FrameBlocks<T> blocks(args.shape.joints);
  Scratch<T> scratch(memory, args.shape);
  for (std::int64_t clip = clips.begin; clip < clips.end; ++clip) recover_clip(args, clip, blocks, scratch);
}

// Rotates the gradient of one frame back and sums what its joints send to the root. `g` and `in` may be read a
// little past their row, `out` is written a little past channel 4 + 3 (J - 1).
template <class T>
CONTROLMM_INLINE void rotate_frame_backward(const T* in, const T* g, T* out, T cosine, T sine,
                                            const FrameBlocks<T>& blocks, RootGradient root, std::int64_t t) {
  const Lanes<T> c = broadcast(cosine), s = broadcast(sine);
  Lanes<T> sum_x = zeros<T>(), sum_z = zeros<T>(), sum_yaw = zeros<T>();
  for (std::int64_t b = 0; b < blocks.count; ++b) {
    const std::int64_t k = 3 + b * kLanes;
    const Roles<T>& role = blocks.of(b);
    const Lanes<T> own = load(g + k);
    const Lanes<T> partner = select(role.x, load(g + k + 2), zeros<T>() - load(g + k - 2));
    const Lanes<T> local = load(in + k + 1);
    store(out + k + 1, select(role.y_or_none, own, c * own + s * partner));
    sum_yaw = sum_yaw + select(role.y_or_none, zeros<T>(), local * (c * partner - s * own));
    sum_x = sum_x + select(role.x, own, zeros<T>());
    sum_z = sum_z + select(role.z, own, zeros<T>());
  }
  out[3] = g[1];
  root.x[t] = static_cast<double>(sum(sum_x)) + static_cast<double>(g[0]);
  root.z[t] = static_cast<double>(sum(sum_z)) + static_cast<double>(g[2]);
  root.yaw[t] = static_cast<double>(sum(sum_yaw));
}

// Channels that carry nothing into the joints, where a frame is not one run of memory.
template <class T>
void zero_channels(const Strided3<T>& grad, T* clip, const MotionShape& shape, std::int64_t first) {
  for (std::int64_t c = first; c < shape.dim; ++c) {
    T* channel = clip + c * grad.channel;
    if (grad.frame == 1) {
      __builtin_memset(channel, 0, static_cast<std::size_t>(shape.frames) * sizeof(T));
      continue;
    }
    for (std::int64_t t = 0; t < shape.frames; ++t) channel[t * grad.frame] = 0;
  }
}

template <class T>
void recover_clip_backward(const RecoverBackwardArgs<T>& args, std::int64_t clip, const FrameBlocks<T>& blocks,
                           Scratch<T>& scratch) {
  const MotionShape& shape = args.shape;
  const Strided3<const T>& f = args.features;
  const Strided4<const T>& g = args.grad_joints;
  const Strided3<T>& d = args.grad_features;
  const T* features = f.data + clip * f.clip;
  const T* cotangents = g.data + clip * g.clip;
  T* grad = d.data + clip * d.clip;
  compute_heading(features, f.frame, f.channel, shape.frames, kDenormalised, scratch.heading);

  const std::int64_t channels = 4 + blocks.values, values = 3 * shape.joints, reach = row_reach(shape);
  const bool reads_in_place = f.channel == 1 && f.frame >= channels && f.frame + channels >= reach;
  const bool gradient_in_place = g.coord == 1 && g.joint == 3 && g.frame >= values && g.frame + values >= reach;
  const bool writes_in_place = d.channel == 1 && shape.dim >= reach;
  for (std::int64_t t = 0; t < shape.frames; ++t) {
    const bool is_last = t + 1 == shape.frames;
    const T* in = features + t * f.frame;
    const T* own = cotangents + t * g.frame;
    T* out = grad + t * d.frame;
    if (!reads_in_place || is_last) {
      copy_row(in, f.channel, channels, scratch.rows[0]);
      in = scratch.rows[0];
    }
    if (!gradient_in_place || is_last) {
      for (std::int64_t j = 0; j < shape.joints; ++j) copy_row(own + j * g.joint, g.coord, 3, scratch.rows[1] + 3 * j);
      own = scratch.rows[1];
    }
    T* target = writes_in_place ? out : scratch.rows[2];
    if (reads_in_place) prefetch_row(in + kRowsAhead * f.frame, channels);
    if (d.channel == 1) prefetch_row(out + kRowsAhead * d.frame, shape.dim);
    rotate_frame_backward(in, own, target, static_cast<T>(scratch.heading.cos[t]),
                          static_cast<T>(scratch.heading.sin[t]), blocks, scratch.gradient, t);
    if (target != out)
      for (std::int64_t c = 3; c < channels; ++c) out[c * d.channel] = target[c];
    if (d.channel == 1) __builtin_memset(out + channels, 0, static_cast<std::size_t>(shape.dim - channels) * sizeof(T));
  }
  if (d.channel != 1) zero_channels(d, grad, shape, channels);
  heading_backward(features, f.frame, f.channel, shape.frames, kDenormalised, scratch.heading, scratch.gradient, grad,
                   d.frame, d.channel);
}

template <class T>
void recover_joints_backward(const RecoverBackwardArgs<T>& args, ClipRange clips, double* memory) {
  const FrameBlocks<T> blocks(args.shape.joints);
  Scratch<T> scratch(memory, args.shape);
  for (std::int64_t clip = clips.begin; clip < clips.end; ++clip) recover_clip_backward(args, clip, blocks, scratch);
}
