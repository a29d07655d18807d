// Local rotations that follow bones: what a bone swung by turns the rotation that points it. One frame a lane.

// A matrix by its columns.
struct Rotation {
  Points<double> x, y, z;
};

CONTROLMM_INLINE Points<double> cross(const Points<double>& a, const Points<double>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

CONTROLMM_INLINE Points<double> turned(const Rotation& by, const Points<double>& p) {
  return {by.x.x * p.x + by.y.x * p.y + by.z.x * p.z, by.x.y * p.x + by.y.y * p.y + by.z.y * p.z,
          by.x.z * p.x + by.y.z * p.y + by.z.z * p.z};
}
CONTROLMM_INLINE Rotation turned(const Rotation& by, const Rotation& a) {
  return {turned(by, a.x), turned(by, a.y), turned(by, a.z)};
}

// By the transpose.
CONTROLMM_INLINE Points<double> seen_from(const Rotation& a, const Points<double>& p) {
  return {dot(a.x, p), dot(a.y, p), dot(a.z, p)};
}

// The quaternion may have any length.
CONTROLMM_INLINE Rotation rotation_of_quaternion(const Lanes<double>& w, const Points<double>& v) {
  const Lanes<double> one = broadcast(1.0), s = broadcast(2.0) / (w * w + dot(v, v));
  return {{one - s * (v.y * v.y + v.z * v.z), s * (v.x * v.y + v.z * w), s * (v.x * v.z - v.y * w)},
          {s * (v.x * v.y - v.z * w), one - s * (v.x * v.x + v.z * v.z), s * (v.y * v.z + v.x * w)},
          {s * (v.x * v.z + v.y * w), s * (v.y * v.z - v.x * w), one - s * (v.x * v.x + v.y * v.y)}};
}

// The shortest; no number for opposite bones and those without length.
CONTROLMM_INLINE Rotation swing_between(const Points<double>& a, const Points<double>& b) {
  return rotation_of_quaternion(sqrt(dot(a, a) * dot(b, b)) + dot(a, b), cross(a, b));
}

CONTROLMM_INLINE Points<double> unit(const Points<double>& a) {
  const Lanes<double> length = sqrt(dot(a, a)), least = broadcast(1e-12);  // as torch's `normalize` has it
  return a * (broadcast(1.0) / select(length < least, least, length));
}

// Of a 6D rotation; they need be neither unit vectors nor at right angles.
CONTROLMM_INLINE Rotation rotation_of_columns(const Points<double>& first, const Points<double>& second) {
  const Points<double> x = unit(first), z = unit(cross(x, second));
  return {x, cross(z, x), z};
}

// One a joint, in memory that need not be aligned.
struct Rotations {
  double* rows;
  CONTROLMM_INLINE Rotation operator[](std::int64_t joint) const {
    const double* p = rows + joint * kRotationRows * kLanes;
    const auto row = [p](int i) __attribute__((always_inline)) { return load(p + i * kLanes); };
    return {{row(0), row(1), row(2)}, {row(3), row(4), row(5)}, {row(6), row(7), row(8)}};
  }
  CONTROLMM_INLINE void set(std::int64_t joint, const Rotation& rotation) const {
    double* p = rows + joint * kRotationRows * kLanes;
    for (const Points<double>* column : {&rotation.x, &rotation.y, &rotation.z})
      for (const Lanes<double>* row : {&column->x, &column->y, &column->z}) {
        store(p, *row);
        p += kLanes;
      }
  }
};

// Three numbers of frames that are `stride` apart.
CONTROLMM_INLINE Points<double> load_frames(const double* p, std::int64_t stride, std::int64_t n) {
  return load_points(p, stride, 1, n);
}
CONTROLMM_INLINE void store_frames(double* p, std::int64_t stride, std::int64_t n, const Points<double>& a) {
  store_strided(p, stride, n, a.x);
  store_strided(p + 1, stride, n, a.y);
  store_strided(p + 2, stride, n, a.z);
}

// Sixteen frames, of which `n` are there, from frame `t` on.
inline void swing_frames(const SwingArgs& args, std::int64_t t, std::int64_t n, double* memory) {
  const BodyTree& body = args.body;
  const std::int64_t places = 3 * body.joints, numbers = 6 * (body.joints - 1);
  const double *before = args.before + t * places, *after = args.after + t * places, *heading = args.heading + 4 * t;
  const Rotations old = {memory}, moved = {memory + body.joints * kRotationRows * kLanes};
  const Rotation facing = rotation_of_quaternion(load_strided(heading, 4, n), load_frames(heading + 1, 4, n));
  old.set(0, facing);
  moved.set(0, facing);
  for (std::int64_t j = 1; j < body.joints; ++j) {
    const std::int64_t parent = body.parents[j], carrier = args.starts[j] ? 0 : parent;
    const auto bone = [&](const double* joints) __attribute__((always_inline)) {
      return load_frames(joints + 3 * j, places, n) - load_frames(joints + 3 * parent, places, n);
    };
    const Rotation frame = old[carrier], swung = turned(swing_between(bone(before), bone(after)), frame);
    double* const six = args.rotations + t * numbers + 6 * (j - 1);
    const Points<double> first = load_frames(six, numbers, n), second = load_frames(six + 3, numbers, n);
    const Rotation base = moved[carrier];
    store_frames(six, numbers, n, seen_from(base, turned(swung, first)));
    store_frames(six + 3, numbers, n, seen_from(base, turned(swung, second)));
    const Rotation own = rotation_of_columns(first, second);
    old.set(j, turned(frame, own));
    moved.set(j, turned(swung, own));
  }
}

inline void swing_rotations(const SwingArgs& args, double* memory) {
  for (std::int64_t t = 0; t < args.body.frames; t += kLanes)
    swing_frames(args, t, lanes_left(args.body.frames, t), memory);
}
