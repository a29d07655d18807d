// Signed distances of sixteen frames of one joint to moving primitives, with their gradients.

template <class T>
struct Distance {
  Lanes<T> value;
  Points<T> normal;  // gradient of the value
};

template <class T>
CONTROLMM_INLINE Points<T> operator-(const Points<T>& a, const Points<T>& b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <class T>
CONTROLMM_INLINE Points<T> operator*(const Points<T>& a, const Lanes<T>& b) {
  return {a.x * b, a.y * b, a.z * b};
}
template <class T>
CONTROLMM_INLINE Lanes<T> dot(const Points<T>& a, const Points<T>& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

// One obstacle's parameters for sixteen frames: row i holds parameter i.
template <class T>
struct Staged {
  const T* rows;
  CONTROLMM_INLINE Lanes<T> scalar(int i) const { return load(rows + i * kLanes); }
  CONTROLMM_INLINE Points<T> point(int i) const { return {scalar(i), scalar(i + 1), scalar(i + 2)}; }
};

// The gradient of a length is the unit vector, and 0 at 0.
template <class T>
CONTROLMM_INLINE Distance<T> distance_to_ball(const Points<T>& offset, const Lanes<T>& radius) {
  const Lanes<T> length = sqrt(dot(offset, offset));
  const Lanes<T> inverse = select(length == zeros<T>(), zeros<T>(), broadcast(T{1}) / length);
  return {length - radius, offset * inverse};
}

template <class T>
CONTROLMM_INLINE Points<T> nearest_on_segment_offset(const Points<T>& p, const Staged<T>& s) {
  const Points<T> a = s.point(0), axis = s.point(3) - a, from_a = p - a;
  const Lanes<T> zero = zeros<T>(), one = broadcast(T{1}), squared = dot(axis, axis);
  const Lanes<T> along = select(squared == zero, zero, dot(from_a, axis) / squared);
  // Comparisons, not min and max, so that a NaN point stays NaN.
  return from_a - axis * select(along < zero, zero, select(along > one, one, along));
}

// A point as an oriented box sees it: along its axes, and how far past its faces.
template <class T>
struct InBox {
  Points<T> local, beyond;
};

template <class T>
CONTROLMM_INLINE InBox<T> point_in_box(const Points<T>& p, const Staged<T>& s) {
  const Points<T> offset = p - s.point(0), row0 = s.point(6), row1 = s.point(9), row2 = s.point(12);
  const Points<T> local = {offset.x * row0.x + offset.y * row1.x + offset.z * row2.x,
                           offset.x * row0.y + offset.y * row1.y + offset.z * row2.y,
                           offset.x * row0.z + offset.y * row1.z + offset.z * row2.z};
  return {local, Points<T>{abs(local.x), abs(local.y), abs(local.z)} - s.point(3)};
}

template <class T>
CONTROLMM_INLINE Distance<T> distance_to_box(const InBox<T>& p, const Staged<T>& s) {
  const Points<T>&local = p.local, &beyond = p.beyond;
  const Lanes<T> zero = zeros<T>(), one = broadcast(T{1});
  const auto positive = [&](const Lanes<T>& a) { return select(a <= zero, zero, a); };
  const Points<T> outside = {positive(beyond.x), positive(beyond.y), positive(beyond.z)};
  const Distance<T> corner = distance_to_ball(outside, zero);
  // Inside, the nearest face: the axis with the largest value, the first one on ties.
  const Mask<T> x_wins = (beyond.x >= beyond.y) & (beyond.x >= beyond.z);
  const Mask<T> y_wins = ~x_wins & (beyond.y >= beyond.z);
  const Lanes<T> deepest = select(x_wins, beyond.x, select(y_wins, beyond.y, beyond.z));
  const Mask<T> is_inside = deepest < zero;
  const Points<T> face = {select(x_wins, one, zero), select(y_wins, one, zero), select(x_wins | y_wins, zero, one)};
  const Points<T> n = {select(is_inside, face.x, corner.normal.x) * sign(local.x),
                       select(is_inside, face.y, corner.normal.y) * sign(local.y),
                       select(is_inside, face.z, corner.normal.z) * sign(local.z)};
  return {select(is_inside, deepest, corner.value), {dot(s.point(6), n), dot(s.point(9), n), dot(s.point(12), n)}};
}

template <class T>
CONTROLMM_INLINE Distance<T> distance_to_half_space(const Points<T>& p, const Staged<T>& s) {
  const Points<T> normal = s.point(0);
  return {dot(p, normal) - s.scalar(3), normal};
}

template <class T>
CONTROLMM_INLINE Distance<T> distance_to_plane(const Points<T>& p, const Staged<T>& s) {
  const Distance<T> side = distance_to_half_space(p, s);
  return {abs(side.value), side.normal * sign(side.value)};
}

// Position on one axis of a height field: cell, fraction in it, and whether the border was not passed.
template <class T>
struct Cell {
  std::int64_t index;
  T fraction;
  T slope;  // 1 inside, 0 where the border value continues
};

template <class T>
inline Cell<T> cell_at(T position, std::int64_t samples) {
  const T last = static_cast<T>(samples - 1);
  const bool is_below = position<0, is_above = position> last;
  const T clamped = is_below ? T{0} : is_above ? last : position;
  std::int64_t index = clamped >= 0 ? static_cast<std::int64_t>(clamped) : 0;  // a NaN stays in the fraction
  if (index > samples - 2) index = samples - 2;
  return {index, clamped - static_cast<T>(index), is_below || is_above ? T{0} : T{1}};
}

template <class T>
inline Distance<T> distance_to_height_field(const Points<T>& p, const Staged<T>& s, const T* heights,
                                            const std::int64_t* kind) {
  T x[kLanes], z[kLanes], height[kLanes], slope_x[kLanes], slope_z[kLanes];
  store(x, (p.x - s.scalar(0)) / s.scalar(2));
  store(z, (p.z - s.scalar(1)) / s.scalar(3));
  const T* grid = heights + kind[1];
  const std::int64_t rows = kind[2], columns = kind[3];
  for (std::int64_t i = 0; i < kLanes; ++i) {
    const Cell<T> u = cell_at(x[i], rows), v = cell_at(z[i], columns);
    const T* corner = grid + u.index * columns + v.index;
    const T low = corner[0] + (corner[1] - corner[0]) * v.fraction;
    const T high = corner[columns] + (corner[columns + 1] - corner[columns]) * v.fraction;
    height[i] = low + (high - low) * u.fraction;
    slope_x[i] = u.slope * (high - low);
    slope_z[i] = v.slope * ((corner[1] - corner[0]) +
                            ((corner[columns + 1] - corner[columns]) - (corner[1] - corner[0])) * u.fraction);
  }
  const Lanes<T> zero = zeros<T>();
  return {p.y - load(height),
          {zero - load(slope_x) / s.scalar(2), broadcast(T{1}), zero - load(slope_z) / s.scalar(3)}};
}

// What one joint collects from all obstacles.
template <class T>
struct Collision {
  Lanes<T> depth;
  Points<T> gradient;  // of the depth
};

template <class T>
CONTROLMM_INLINE void add_collision(Collision<T>& sum, const Distance<T>& distance, const Lanes<T>& clearance,
                                    const Mask<T>& counts) {
  const Lanes<T> depth = clearance - distance.value, zero = zeros<T>();
  const Mask<T> hits = ~(depth <= zero) & counts;  // a NaN depth hits: it must show
  sum.depth = sum.depth + select(hits, depth, zero);
  sum.gradient.x = sum.gradient.x - select(hits, distance.normal.x, zero);
  sum.gradient.y = sum.gradient.y - select(hits, distance.normal.y, zero);
  sum.gradient.z = sum.gradient.z - select(hits, distance.normal.z, zero);
}

// Without any frame near enough, the root and the division are saved. The slack covers their rounding, so that what is
// left out is exactly 0.
constexpr double kSlack = 1.0001;

template <class T>
CONTROLMM_INLINE void collide_with_ball(Collision<T>& sum, const Points<T>& offset, const Lanes<T>& radius,
                                        const Lanes<T>& clearance, const Mask<T>& counts) {
  const Lanes<T> reach = radius + clearance, slack = broadcast(T(kSlack));
  if (!any(~(dot(offset, offset) > reach * reach * slack) & counts)) return;
  add_collision(sum, distance_to_ball(offset, radius), clearance, counts);
}

template <class T>
CONTROLMM_INLINE void collide_with_box(Collision<T>& sum, const Points<T>& p, const Staged<T>& s,
                                       const Lanes<T>& clearance, const Mask<T>& counts) {
  const InBox<T> in = point_in_box(p, s);
  const Points<T>& beyond = in.beyond;
  const Lanes<T> reach = clearance * broadcast(T(kSlack)), total = beyond.x + beyond.y + beyond.z;
  const Mask<T> is_far = (beyond.x > reach) | (beyond.y > reach) | (beyond.z > reach), is_number = total == total;
  if (!any(~(is_far & is_number) & counts)) return;
  add_collision(sum, distance_to_box(in, s), clearance, counts);
}

template <class T>
CONTROLMM_INLINE void collide(Collision<T>& sum, const Points<T>& p, const std::int64_t* kind, const Staged<T>& s,
                              const T* heights, const Lanes<T>& clearance, const Mask<T>& counts) {
  switch (static_cast<ObstacleKind>(kind[0])) {
    case ObstacleKind::sphere:
      return collide_with_ball(sum, p - s.point(0), s.scalar(3), clearance, counts);
    case ObstacleKind::capsule:
      return collide_with_ball(sum, nearest_on_segment_offset(p, s), s.scalar(6), clearance, counts);
    case ObstacleKind::box:
      return collide_with_box(sum, p, s, clearance, counts);
    case ObstacleKind::plane:
      return add_collision(sum, distance_to_plane(p, s), clearance, counts);
    case ObstacleKind::half_space:
      return add_collision(sum, distance_to_half_space(p, s), clearance, counts);
    case ObstacleKind::height_field:
      return add_collision(sum, distance_to_height_field(p, s, heights, kind), clearance, counts);
  }
}

constexpr int kParametersOf[] = {4, 7, 15, 4, 4, 4};  // by kind

template <class T>
inline void stage_obstacles(const ObstacleArgs<T>& args, std::int64_t clip, std::int64_t first, std::int64_t n,
                            T* staged) {
  const Strided4<const T>& p = args.parameters;
  for (std::int64_t o = 0; o < args.count; ++o, staged += kObstacleParameters * kLanes) {
    const T* from = p.data + clip * p.clip + first * p.frame + o * p.joint;
    for (int i = 0; i < kParametersOf[args.kinds[4 * o]]; ++i) {
      const T* row = from + i * p.coord;
      __builtin_prefetch(row + kLanes * p.frame);  // wanted by the next sixteen frames
      store(staged + i * kLanes, load_strided(row, p.frame, n));
    }
  }
}

// Too long to be worth a copy in each of its callers. Sums in a local variable stay in registers.
template <class T>
__attribute__((noinline)) void collide_with_all(const ObstacleArgs<T>& args, const T* staged, std::int64_t joint,
                                                const Points<T>& p, const Mask<T>& counts, Collision<T>& out) {
  Collision<T> sum = {zeros<T>(), {zeros<T>(), zeros<T>(), zeros<T>()}};
  const Lanes<T> clearance = broadcast(args.margin + args.radii[joint]);
  for (std::int64_t o = 0; o < args.count; ++o)
    collide(sum, p, args.kinds + 4 * o, Staged<T>{staged + o * kObstacleParameters * kLanes}, args.heights, clearance,
            counts);
  out = sum;
}

template <class T, class F>
CONTROLMM_INLINE void for_each_collision(const ObstacleLossArgs<T>& args, std::int64_t clip, T* staged, F visit) {
  const ObstacleArgs<T>& obstacles = args.obstacles;
  const Strided4<const T>& a = args.joints;
  const std::int64_t length = obstacles.lengths[clip];
  for (std::int64_t t = 0; t < length; t += kLanes) {
    const std::int64_t n = lanes_left(length, t);
    stage_obstacles(obstacles, clip, t, n, staged);
    const Mask<T> counts = first_lanes<T>(n);
    for (std::int64_t j = 0; j < args.shape.joints; ++j) {
      if (!obstacles.is_active[j]) continue;
      const T* at = a.data + clip * a.clip + t * a.frame + j * a.joint;
      Collision<T> collision;
      collide_with_all(obstacles, staged, j, load_points(at, a.frame, a.coord, n), counts, collision);
      visit(t, n, j, collision);
    }
  }
}

template <class T>
void obstacle_loss(const ObstacleLossArgs<T>& args, ClipRange clips, double* scratch) {
  for (std::int64_t clip = clips.begin; clip < clips.end; ++clip) {
    Lanes<double> total = zeros<double>();
    for_each_collision(
        args, clip, reinterpret_cast<T*>(scratch),
        [&](std::int64_t, std::int64_t, std::int64_t, const Collision<T>& c) { total = total + to_double(c.depth); });
    args.sums[clip] = sum(total);
  }
}

// The caller has zeroed the gradient: frames and joints that do not count are not visited.
template <class T>
void obstacle_loss_backward(const ObstacleLossArgs<T>& args, ClipRange clips, double* scratch) {
  const Strided4<T>& g = args.grad_joints;
  for (std::int64_t clip = clips.begin; clip < clips.end; ++clip) {
    const Lanes<T> scale = broadcast(args.scales[clip]);
    for_each_collision(args, clip, reinterpret_cast<T*>(scratch),
                       [&](std::int64_t t, std::int64_t n, std::int64_t j, const Collision<T>& c) {
                         T* at = g.data + clip * g.clip + t * g.frame + j * g.joint;
                         store_strided(at, g.frame, n, c.gradient.x * scale);
                         store_strided(at + g.coord, g.frame, n, c.gradient.y * scale);
                         store_strided(at + 2 * g.coord, g.frame, n, c.gradient.z * scale);
                       });
  }
}
