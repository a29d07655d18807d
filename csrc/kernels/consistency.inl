// Distance of controlled joints to their targets, sixteen joints at a time. Tiles without a controlled joint are
// skipped before any position is read: control is usually sparse.

template <class T>
struct Points {
  Lanes<T> x, y, z;
};

template <class T>
CONTROLMM_INLINE Points<T> load_points(const T* p, std::int64_t joint, std::int64_t coord, std::int64_t n) {
  return {load_strided(p, joint, n), load_strided(p + coord, joint, n), load_strided(p + 2 * coord, joint, n)};
}

template <class T>
CONTROLMM_INLINE void store_points(T* p, std::int64_t n, const Points<T>& points) {
  T buffer[3][kLanes];
  store(buffer[0], points.x);
  store(buffer[1], points.y);
  store(buffer[2], points.z);
  for (std::int64_t i = 0; i < n; ++i)
    for (std::int64_t c = 0; c < 3; ++c) p[3 * i + c] = buffer[c][i];
}

template <class T>
struct PointMask {
  Mask<T> x, y, z;
  bool is_empty;
  std::int64_t joints, coords;  // masked ones in this tile
};

template <class T>
CONTROLMM_INLINE PointMask<T> load_point_mask(const std::uint8_t* p, std::int64_t joint, std::int64_t coord,
                                              std::int64_t n) {
  PointMask<T> mask;
  mask.joints = mask.coords = 0;
  std::uint8_t buffer[3][kLanes] = {};
  for (std::int64_t i = 0; i < n; ++i) {
    const std::uint8_t* at = p + i * joint;
    const int x = at[0] != 0, y = at[coord] != 0, z = at[2 * coord] != 0;
    buffer[0][i] = at[0];
    buffer[1][i] = at[coord];
    buffer[2][i] = at[2 * coord];
    mask.coords += x + y + z;
    mask.joints += x | y | z;
  }
  mask.is_empty = mask.joints == 0;
  mask.x = load_mask<T>(buffer[0]);
  mask.y = load_mask<T>(buffer[1]);
  mask.z = load_mask<T>(buffer[2]);
  return mask;
}

template <class T>
CONTROLMM_INLINE Points<T> masked_difference(const Points<T>& a, const Points<T>& b, const PointMask<T>& m) {
  return {select(m.x, a.x - b.x, zeros<T>()), select(m.y, a.y - b.y, zeros<T>()), select(m.z, a.z - b.z, zeros<T>())};
}

template <class T>
struct Penalty {
  Lanes<T> value;
  Points<T> gradient;  // of scale * value
};

// Value and gradient together: the root of the distance serves both.
template <class T>
CONTROLMM_INLINE Penalty<T> penalty_of(const Points<T>& d, Norm norm, const Lanes<T>& scale) {
  if (norm == Norm::l1)
    return {abs(d.x) + abs(d.y) + abs(d.z), {scale * sign(d.x), scale * sign(d.y), scale * sign(d.z)}};
  const Lanes<T> squared = d.x * d.x + d.y * d.y + d.z * d.z;
  if (norm == Norm::mse) {
    const Lanes<T> twice = scale + scale;
    return {squared, {twice * d.x, twice * d.y, twice * d.z}};
  }
  const Lanes<T> distance = sqrt(squared);
  const Lanes<T> inverse = select(distance == zeros<T>(), zeros<T>(), scale / distance);
  return {distance, {d.x * inverse, d.y * inverse, d.z * inverse}};
}

// Runs of joints with one stride. A clip whose frames follow one another is a single long run.
struct Runs {
  std::int64_t count, length;
};

template <class T>
bool frames_are_joined(const Strided4<T>& a, std::int64_t joints) {
  return a.frame == joints * a.joint;
}

template <class T>
Runs runs_of(const ConsistencyArgs<T>& a) {
  const MotionShape& s = a.shape;
  const bool joined = frames_are_joined(a.joints, s.joints) && frames_are_joined(a.targets, s.joints) &&
                      frames_are_joined(a.mask, s.joints);
  return joined ? Runs{1, s.frames * s.joints} : Runs{s.frames, s.joints};
}

template <class T, class F>
CONTROLMM_INLINE void for_each_tile(const ConsistencyArgs<T>& a, std::int64_t clip, F visit) {
  const Runs runs = runs_of(a);
  for (std::int64_t run = 0; run < runs.count; ++run) {
    for (std::int64_t i = 0; i < runs.length; i += kLanes) {
      const std::int64_t n = lanes_left(runs.length, i);
      const std::uint8_t* at = a.mask.data + clip * a.mask.clip + run * a.mask.frame + i * a.mask.joint;
      const PointMask<T> mask = load_point_mask<T>(at, a.mask.joint, a.mask.coord, n);
      if (mask.is_empty) continue;
      const T* joints = a.joints.data + clip * a.joints.clip + run * a.joints.frame + i * a.joints.joint;
      const T* targets = a.targets.data + clip * a.targets.clip + run * a.targets.frame + i * a.targets.joint;
      const Points<T> difference = masked_difference(load_points(joints, a.joints.joint, a.joints.coord, n),
                                                     load_points(targets, a.targets.joint, a.targets.coord, n), mask);
      visit(run * a.shape.joints + i, n, mask, difference);
    }
  }
}

template <class T>
void consistency(const ConsistencyArgs<T>& args, ClipRange clips) {
  for (std::int64_t clip = clips.begin; clip < clips.end; ++clip) {
    Lanes<double> total = zeros<double>();
    std::int64_t count = 0;
    for_each_tile(args, clip, [&](std::int64_t, std::int64_t, const PointMask<T>& mask, const Points<T>& difference) {
      total = total + to_double(penalty_of(difference, args.norm, zeros<T>()).value);
      count += args.norm == Norm::l2 ? mask.joints : mask.coords;
    });
    args.sums[clip] = sum(total);
    args.counts[clip] = static_cast<double>(count);
  }
}

template <class T>
void consistency_backward(const ConsistencyArgs<T>& args, ClipRange clips) {
  const std::int64_t values = args.shape.frames * args.shape.joints * 3;
  for (std::int64_t clip = clips.begin; clip < clips.end; ++clip) {
    T* grad = args.grad_joints + clip * values;
    __builtin_memset(grad, 0, static_cast<std::size_t>(values) * sizeof(T));
    const Lanes<T> scale = broadcast(args.scales[clip]);
    for_each_tile(args, clip, [&](std::int64_t first, std::int64_t n, const PointMask<T>& mask, const Points<T>& d) {
      const Points<T> g = penalty_of(d, args.norm, scale).gradient;
      const Lanes<T> zero = zeros<T>();
      store_points(grad + 3 * first, n,
                   Points<T>{select(mask.x, g.x, zero), select(mask.y, g.y, zero), select(mask.z, g.z, zero)});
    });
  }
}
