// Bones of the right length frame by frame: Newton's method on the constraints, each frame the nearest pose. Where a
// leg is nearly straight, a step that spares the foot swings the knee about; such frames get a second half of steps
// in which all joints are alike.

// How joints give way to a force on one of them, per axis; the same for frames with the same flags.
class Yielding {
 public:
  Yielding(const FrameBonesArgs& args, double* memory)
      : args_(args), joints_(args.body.joints), memory_(memory), rows_(memory + banded_scratch(joints_, joints_ - 1)) {}

  void set_frame(std::int64_t t) {
    const bool is_same = t > 0 && extra_ == 0 && same(args_.held, t, 3 * joints_) && same(args_.planted, t, joints_);
    if (!is_same) set_frame(t, 0);
  }

  /// The same with more resistance of all joints: feet are then no heavier than knees.
  void set_frame(std::int64_t t, double extra) {
    extra_ = extra;
    for (int axis = 0; axis < 3; ++axis) invert(t, axis);
  }

  /// Answer of joint i along an axis to a force on joint j.
  double at(int axis, std::int64_t i, std::int64_t j) const { return rows_[(axis * joints_ + j) * row() + i]; }

  static constexpr std::int64_t scratch(std::int64_t joints) {
    return banded_scratch(joints, joints - 1) + 3 * joints * (joints + banded_stride(joints - 1));
  }

 private:
  std::int64_t row() const { return joints_ + banded_stride(joints_ - 1); }

  static bool same(const std::uint8_t* flags, std::int64_t t, std::int64_t n) {
    return __builtin_memcmp(flags + t * n, flags + (t - 1) * n, static_cast<std::size_t>(n)) == 0;
  }

  void invert(std::int64_t t, int axis) {
    const std::uint8_t* held = args_.held + 3 * t * joints_ + axis;
    Banded system(memory_, joints_, joints_ - 1);
    for (std::int64_t j = 0; j < joints_; ++j) {
      const double foot = args_.feet[j] ? args_.foot_resistance : 0;
      system.add(j, j, 1 + extra_ + foot + (args_.planted[t * joints_ + j] ? args_.standing : 0));
      if (args_.body.parents[j] >= 0) system.tie(j, args_.body.parents[j], args_.stiffness);
    }
    double* first = rows_ + axis * joints_ * row();
    for (std::int64_t i = 0; i < joints_ * row(); ++i) first[i] = 0;
    system.hold(held, 3, first);  // a right side of zeros: held joints do not move
    system.factorise();
    for (std::int64_t j = 0; j < joints_; ++j) {
      if (held[3 * j]) continue;
      first[j * row() + j] = 1;
      system.solve(first + j * row());
    }
  }

  const FrameBonesArgs& args_;
  std::int64_t joints_;
  double *memory_, *rows_;
  double extra_ = 0;
};

// One step of a frame; says whether its bones were long enough already.
inline bool restore_step(const FrameBonesArgs& args, const Yielding& yields, double* frame, double* memory) {
  const BodyTree& body = args.body;
  const std::int64_t bones = body.joints - 1;
  Banded system(memory, bones, bones - 1);
  double* forces = memory + banded_scratch(bones, bones - 1);
  Bone* const bone = reinterpret_cast<Bone*>(forces + bones + banded_stride(bones - 1));
  double* move = reinterpret_cast<double*>(bone + bones);
  double worst = 0;
  for (std::int64_t b = 0; b < bones; ++b) {
    bone[b] = bone_of(frame, b + 1, body.parents[b + 1]);
    forces[b] = args.lengths[b + 1] - bone[b].length;
    const double error = std::fabs(forces[b]);
    if (error > worst || error != error) worst = error;  // one that is no number stays
  }
  if (worst < args.enough) return true;
  for (std::int64_t i = 0; i < banded_stride(bones - 1); ++i) forces[bones + i] = 0;
  for (std::int64_t a = 0; a < bones; ++a) {
    const std::int64_t child = a + 1, parent = body.parents[a + 1];
    for (std::int64_t b = 0; b <= a; ++b) {
      const std::int64_t other = b + 1, up = body.parents[b + 1];
      double answer = a == b ? args.slack : 0;
      for (int c = 0; c < 3; ++c)
        answer += bone[a].direction[c] * bone[b].direction[c] *
                  ((yields.at(c, child, other) - yields.at(c, child, up)) -
                   (yields.at(c, parent, other) - yields.at(c, parent, up)));
      system.add(a, b, answer);
    }
  }
  system.factorise();
  system.solve(forces);
  double farthest = 0;
  for (std::int64_t j = 0; j < body.joints; ++j)
    for (int c = 0; c < 3; ++c) {
      double& moved = move[3 * j + c];
      moved = 0;
      for (std::int64_t b = 0; b < bones; ++b)
        moved += forces[b] * bone[b].direction[c] * (yields.at(c, j, b + 1) - yields.at(c, j, body.parents[b + 1]));
      if (std::fabs(moved) > farthest) farthest = std::fabs(moved);
    }
  const double share = farthest > args.longest ? args.longest / farthest : 1;
  for (std::int64_t k = 0; k < 3 * body.joints; ++k) frame[k] += share * move[k];
  return false;
}

inline void frame_bones(const FrameBonesArgs& args, double* memory) {
  Yielding yields(args, memory);
  double* own = memory + Yielding::scratch(args.body.joints);
  for (std::int64_t t = 0; t < args.body.frames; ++t) {
    double* frame = args.joints + 3 * t * args.body.joints;
    yields.set_frame(t);
    for (std::int64_t n = 0; n < args.steps; ++n) {
      if (restore_step(args, yields, frame, own)) break;
      if (2 * (n + 1) == args.steps) yields.set_frame(t, args.standing);
    }
  }
}
